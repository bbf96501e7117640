"""What tyres and air do to the pymunk car, with everything that does not change while it drives worked out once."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, sin, sqrt, tanh

from safedpa_sim.robots.car_parameters import GRAVITY, CarParameters

__all__ = ["GroundForces", "ground_forces"]

GroundForces = Callable[[float, float, float, float, float], tuple[float, float, float]]
"""(forward, sideways [m/s], turning rate [rad/s], drive [m/s2], wheels' angle [rad]) of the centre of mass to the force
along and across the car [N] and the torque [N m] about that centre."""

_ROLLING_SPEED = 0.02
"""m/s below which rolling resistance fades, so that it cannot push a standing car."""


def ground_forces(car: CarParameters) -> GroundForces:
    """Tyre forces of both axles (``axle_force``), each under the load that the drive shifts, less the resistance

    mass (rolling tanh(v / 0.02 m/s) + drag |v| v).
    """
    to_rear, to_front, wheelbase = car.centre_of_mass, car.wheelbase - car.centre_of_mass, car.wheelbase
    mass, height, limit = car.mass, car.centre_height, car.mass * GRAVITY * car.friction
    front_slip, rear_slip, slip_speed, rolling, drag = (
        car.front_slip,
        car.rear_slip,
        car.slip_speed,
        car.rolling,
        car.drag,
    )

    def forces(forward: float, sideways: float, rate: float, drive: float, steer: float) -> tuple[float, float, float]:
        # axle_force is written out for both axles: twenty times a period the calls would cost as much as the sums
        share = (to_rear - drive * height / GRAVITY) / wheelbase
        share = 0.0 if share < 0.0 else 1.0 if share > 1.0 else share
        force = mass * drive
        ahead = sideways + rate * to_front
        cosine, sine = cos(steer), sin(steer)
        pushed, most = force * share, limit * share
        along = -most if pushed < -most else most if pushed > most else pushed
        slip = (ahead * cosine - forward * sine) / (front_slip * (abs(forward * cosine + ahead * sine) + slip_speed))
        front_y = -sqrt(most * most - along * along) * slip / sqrt(1.0 + slip * slip)
        rear = 1.0 - share
        pushed, most = force * rear, limit * rear
        rear_x = -most if pushed < -most else most if pushed > most else pushed
        slip = (sideways - rate * to_rear) / (rear_slip * (abs(forward) + slip_speed))
        rear_y = -sqrt(most * most - rear_x * rear_x) * slip / sqrt(1.0 + slip * slip)
        resistance = mass * (rolling * tanh(forward / _ROLLING_SPEED) + drag * abs(forward) * forward)
        across = along * sine + front_y * cosine
        return (
            along * cosine - front_y * sine + rear_x - resistance,
            across + rear_y,
            across * to_front - rear_y * to_rear,
        )

    return forces
