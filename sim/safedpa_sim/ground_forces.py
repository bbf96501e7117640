"""Tyre and ground forces on the simulated car and its load, over plain floats; compiled by mypyc.

Separate from the physics engine, so that it can be imported where pymunk is not installed.
"""

from __future__ import annotations

from math import cos, sin, sqrt, tanh
from typing import TYPE_CHECKING, Final, final

if TYPE_CHECKING:
    from safedpa_sim.robots.car.parameters import CarParameters

GRAVITY: Final = 9.81
"""m/s2."""
_ROLLING_SPEED: Final = 0.02
"""m/s below which rolling resistance fades, so that it cannot push a stationary car."""
_RUNNER_SLIP: Final = 0.1
"""rad; slip angle scale of the runners."""
_RUNNER_SPEED: Final = 0.3
"""m/s added to the sliding speed in their slip angle, so that it is defined at standstill."""


@final
class GroundForces:
    """Tyre forces of both axles with load transfer, minus the driving resistance.

    The forces of an axle in the frame of its wheels are

        F_x = clip(drive, +-limit),  F_y = -sqrt(limit^2 - F_x^2) s / sqrt(1 + s^2)   [N]
        s = sideways / (slip_scale (|rolling| + slip_speed))

    with rolling and sideways [m/s] the velocity of the axle's centre along and across its wheels: a tyre of cornering
    stiffness limit / slip_scale that saturates on the friction circle of radius limit. The resistance is

        mass (rolling tanh(v / 0.02 m/s) + drag |v| v + viscous v + turning |steer| tanh(v / 0.02 m/s))

    Source: the combined-slip friction circle, Rajamani, Vehicle Dynamics and Control, 2nd ed., ch. 13, with a smooth
    saturation.
    """

    def __init__(self, car: CarParameters) -> None:
        self._to_rear: float = car.centre_of_mass
        self._to_front: float = car.wheelbase - car.centre_of_mass
        self._wheelbase: float = car.wheelbase
        self.mass: float = car.mass
        """kg."""
        self._height: float = car.centre_height
        self._limit: float = car.mass * GRAVITY * car.friction
        self._front_slip: float = car.front_slip
        self._rear_slip: float = car.rear_slip
        self._slip_speed: float = car.slip_speed
        self._rolling: float = car.rolling
        self._drag: float = car.drag
        self._viscous: float = car.viscous
        self._turning: float = car.turning

    def of(
        self, forward: float, sideways: float, rate: float, drive: float, steer: float
    ) -> tuple[float, float, float]:
        """Returns the force along and across the car [N] and the torque [N m] about its centre of mass.

        Inputs are forward and sideways speed [m/s] and turning rate [rad/s] of that centre, drive [m/s2] and wheel
        angle [rad].
        """
        # Both axles are written out: with twenty substeps per period, function calls would take as long as the sums.
        mass = self.mass
        share = (self._to_rear - drive * self._height / GRAVITY) / self._wheelbase
        share = 0.0 if share < 0.0 else 1.0 if share > 1.0 else share
        force = mass * drive
        ahead = sideways + rate * self._to_front
        cosine, sine = cos(steer), sin(steer)
        pushed, most = force * share, self._limit * share
        along = -most if pushed < -most else most if pushed > most else pushed
        speed = abs(forward * cosine + ahead * sine) + self._slip_speed
        slip = (ahead * cosine - forward * sine) / (self._front_slip * speed)
        front_y = -sqrt(most * most - along * along) * slip / sqrt(1.0 + slip * slip)
        rear = 1.0 - share
        pushed, most = force * rear, self._limit * rear
        rear_x = -most if pushed < -most else most if pushed > most else pushed
        slip = (sideways - rate * self._to_rear) / (self._rear_slip * (abs(forward) + self._slip_speed))
        rear_y = -sqrt(most * most - rear_x * rear_x) * slip / sqrt(1.0 + slip * slip)
        fading = tanh(forward / _ROLLING_SPEED)
        resistance = mass * (self._rolling * fading + self._drag * abs(forward) * forward)
        across = along * sine + front_y * cosine
        total = along * cosine - front_y * sine + rear_x - resistance
        if self._viscous != 0.0 or self._turning != 0.0:
            total -= mass * (self._viscous * forward + self._turning * abs(steer) * fading)
        return total, across + rear_y, across * self._to_front - rear_y * self._to_rear


@final
class DrivePeriod:
    """The motor's acceleration and the forces of each substep over a period with a constant command.

    ``pull`` is push [m/s2], gain [1/s] and target [m/s] of the motor, whose target acceleration is push + gain (target
    - speed), clipped to +-``limit`` [m/s2]. In a substep the acceleration covers ``share`` of the step to it. ``wind``
    is in m/s2 along the field's x and y.
    """

    def __init__(
        self,
        forces: GroundForces,
        pull: tuple[float, float, float],
        limit: float,
        share: float,
        acceleration: float,
        wind: tuple[float, float],
    ) -> None:
        self._forces = forces
        self._push, self._gain, self._target = pull
        self._limit: float = limit
        self._share: float = share
        self._wind_x, self._wind_y = wind
        self.acceleration: float = acceleration
        """m/s2; at the end of the last substep."""

    def substep(self, yaw: float, vx: float, vy: float, rate: float, steer: float) -> tuple[float, float, float]:
        """Returns force in the field's frame [N] and torque [N m] on the centre of mass from its current motion."""
        cosine, sine = cos(yaw), sin(yaw)
        forward, sideways = vx * cosine + vy * sine, vy * cosine - vx * sine
        wanted = self._push + self._gain * (self._target - forward)  # SpeedServo.advance, inlined
        wanted = -self._limit if wanted < -self._limit else self._limit if wanted > self._limit else wanted
        self.acceleration += (wanted - self.acceleration) * self._share
        along, across, torque = self._forces.of(forward, sideways, rate, self.acceleration, steer)
        mass = self._forces.mass
        to_east = along * cosine - across * sine + mass * self._wind_x
        return to_east, along * sine + across * cosine + mass * self._wind_y, torque


def runner_force(angle: float, vx: float, vy: float, hold: float) -> tuple[float, float]:
    """Returns the force [N] on a load's runners at ``angle`` [rad] and velocity (vx, vy) [m/s], in the field's frame.

    The tyre force of ``GroundForces`` without drive; ``hold`` [N] is the largest force, negative because it opposes the
    slip.
    """
    cosine, sine = cos(angle), sin(angle)
    forward, sideways = vx * cosine + vy * sine, vy * cosine - vx * sine
    slip = sideways / (_RUNNER_SLIP * (abs(forward) + _RUNNER_SPEED))
    across = hold * slip / sqrt(1.0 + slip * slip)
    return -across * sine, across * cosine
