"""Parameters of the simulated cars."""

from __future__ import annotations

from dataclasses import dataclass

SUBSTEP = 1.0 / 400.0
"""s, longest step of the physics: the tyres' lateral damping at standstill is stable only below 1/200 s."""


@dataclass(frozen=True)
class ThrottleParameters:
    """A motor with a throttle from -1 to 1: acceleration = (gain - back_emf v) (throttle beyond the dead zone)."""

    gain: float
    """m/s2 per unit of throttle beyond the dead zone, at standstill."""
    back_emf: float
    """1/s per unit of throttle beyond the dead zone."""
    dead_zone: float
    """Largest absolute throttle without effect."""


@dataclass(frozen=True)
class CarParameters:
    """A 1:10 car; lengths are from the rear axle's centre, forward positive. Values are assumed, as of such cars."""

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
    """rad; smaller than the front value, so that the car understeers slightly."""
    slip_speed: float = 0.3
    """m/s added to the rolling speed in the slip angle, so that it is defined at standstill."""
    servo_gain: float = 5.0
    """1/s."""
    servo_limit: float = 5.0
    """m/s2 times the car's mass is the largest drive and brake force."""
    servo_lag: float = 0.03
    """s; lag of the motor current behind its command."""
    rolling: float = 0.12
    """m/s2; rolling resistance over mass."""
    drag: float = 0.03
    """1/m; air drag over mass and speed squared."""
    steer_lag: float = 0.08
    """s; lag of the steering actuator behind its command."""
    steer_rate: float = 4.0
    """rad/s; largest rate of the steering actuator."""
    steer_limit: float = 0.34
    """rad; largest command."""
    speed_low: float = -0.6
    """m/s; largest command backwards."""
    speed_high: float = 2.0
    """m/s; largest command forwards."""
    throttle: ThrottleParameters | None = None
    """Throttle motor instead of the speed servo, with the servo's lag and limit; None for the speed servo."""
    viscous: float = 0.0
    """1/s; resistance over mass and speed."""
    steer_slope: float = 1.0
    """Wheel angle per small command, rad/rad."""
    steer_end: float = 0.0
    """rad; limit of the wheel angle with a compliant linkage: end tanh(slope command / end); 0 for a rigid linkage."""
    turning: float = 0.0
    """m/s2 per rad of wheel angle; resistance over mass while steering."""


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
"""A simulated stand-in for the car of the DART logs, which is commanded by throttle.

Source: Lyons, Ferranti, DART: A Compact Platform for Autonomous Driving Research, 2024, and the fits in its repository
(Lorenzo-Lyons/DART, dart_dynamic_models.py): forces over the mass. The asymmetry of the steering is neglected. Assumed:
body size, inertia (a box of that size), height of the centre of mass, and slip scales of the tyres.
"""
