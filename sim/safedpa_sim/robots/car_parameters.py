"""The numbers of the simulated car: the reality that models of it are measured against."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CAR_PARAMETERS", "SUBSTEP", "THROTTLE_CAR", "CarParameters", "ThrottleParameters"]

SUBSTEP = 1.0 / 400.0
"""s, longest step of the physics: the tyres' sideways damping at standstill needs less than 1/200 s to be stable."""


@dataclass(frozen=True)
class ThrottleParameters:
    """A motor behind a throttle, -1 to 1: d(v)/dt of the drive = (gain - back_emf v) felt throttle."""

    gain: float
    """m/s2 for each unit of throttle beyond the dead zone, from rest."""
    back_emf: float
    """1/s for each unit of throttle beyond the dead zone."""
    dead_zone: float
    """Throttle that does nothing, either way."""


@dataclass(frozen=True)
class CarParameters:
    """A 1:10 car; lengths from the middle of the rear axle, forward positive. Assumed, in the range of such cars."""

    mass: float = 2.5
    """kg."""
    inertia: float = 0.06
    """kg m2 about the vertical axis through the centre of mass: mass (length^2 + width^2) / 12."""
    wheelbase: float = 0.32
    """m."""
    centre_of_mass: float = 0.15
    """m ahead of the rear axle."""
    centre_height: float = 0.05
    """m above the floor: braking loads the front axle."""
    rear: float = 0.08
    """m from the rear axle to the back of the body; the hitch is there."""
    front: float = 0.40
    """m from the rear axle to the nose."""
    width: float = 0.24
    """m."""
    friction: float = 0.9
    """Largest tyre force over its normal force."""
    front_slip: float = 0.09
    """rad; slip angle scale of the front tyres (s = 1)."""
    rear_slip: float = 0.07
    """rad; smaller than in front: the car understeers a little."""
    slip_speed: float = 0.3
    """m/s added to the rolling speed in the slip angle, so that it is defined at standstill."""
    servo_gain: float = 5.0
    """1/s."""
    servo_limit: float = 5.0
    """m/s2 times the car's mass is the largest drive and brake force."""
    servo_lag: float = 0.03
    """s; the motor current behind its command."""
    rolling: float = 0.12
    """m/s2; rolling resistance over mass."""
    drag: float = 0.03
    """1/m; air drag over mass and speed squared."""
    steer_lag: float = 0.08
    """s; the steering actuator behind its command."""
    steer_rate: float = 4.0
    """rad/s; its fastest turning."""
    steer_limit: float = 0.34
    """rad; largest command."""
    speed_low: float = -0.6
    """m/s; largest command backwards."""
    speed_high: float = 2.0
    """m/s; largest command forwards."""
    throttle: ThrottleParameters | None = None
    """What moves it in place of the speed servo, whose lag and limit hold for it too; None: the servo."""
    viscous: float = 0.0
    """1/s; resistance over mass and speed."""
    steer_slope: float = 1.0
    """rad of the wheels' angle for each rad of a small command."""
    steer_end: float = 0.0
    """rad towards which that angle bends: end tanh(slope command / end); 0: it bends towards none."""
    turning: float = 0.0
    """m/s2 for each rad of the wheels' angle; resistance over mass of a car that steers."""


CAR_PARAMETERS = CarParameters()
"""The default car."""

THROTTLE_CAR = CarParameters(
    mass=1.58,
    inertia=0.0151,
    wheelbase=0.1735,
    centre_of_mass=0.093,
    centre_height=0.04,
    rear=0.045,
    front=0.225,
    width=0.19,
    friction=0.85,
    servo_limit=8.0,
    servo_lag=0.084,
    rolling=0.80,
    drag=0.0,
    steer_lag=0.129,
    throttle=ThrottleParameters(gain=16.05, back_emf=3.05, dead_zone=0.164),
    viscous=0.47,
    steer_slope=1.39,
    steer_end=0.43,
    turning=3.0,
)
"""A stand-in for the car of the DART logs, which is commanded by throttle.

Source: Lyons, Ferranti, DART: A Compact Platform for Autonomous Driving Research, 2024, and the fits in its repository
(Lorenzo-Lyons/DART, dart_dynamic_models.py): forces over the mass. Left out: the steering's asymmetry.
Size of the body, inertia of a box of that size, height of the centre of mass and the tyres' slip scales are assumed.
"""
