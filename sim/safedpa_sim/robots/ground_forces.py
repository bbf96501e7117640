"""What tyres and air do to the pymunk car, with everything that does not change while it drives worked out once."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, sin, tanh

from safedpa_sim.robots.car_parameters import GRAVITY, CarParameters
from safedpa_sim.robots.tyres import axle_force

__all__ = ["GroundForces", "ground_forces"]

GroundForces = Callable[[float, float, float, float, float], tuple[float, float, float]]
"""(forward, sideways [m/s], turning rate [rad/s], drive [m/s2], wheels' angle [rad]) of the centre of mass to the force
along and across the car [N] and the torque [N m] about that centre."""

_ROLLING_SPEED = 0.02
"""m/s below which rolling resistance fades, so that it cannot push a standing car."""


def ground_forces(car: CarParameters) -> GroundForces:
    """Tyre forces of both axles, each on its friction circle under the load that the drive shifts, less the resistance

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
        share = (to_rear - drive * height / GRAVITY) / wheelbase
        share = 0.0 if share < 0.0 else 1.0 if share > 1.0 else share
        force = mass * drive
        ahead = sideways + rate * to_front
        cosine, sine = cos(steer), sin(steer)
        front_x, front_y = axle_force(
            forward * cosine + ahead * sine,
            ahead * cosine - forward * sine,
            force * share,
            limit * share,
            front_slip,
            slip_speed,
        )
        rear = 1.0 - share
        rear_x, rear_y = axle_force(
            forward, sideways - rate * to_rear, force * rear, limit * rear, rear_slip, slip_speed
        )
        resistance = mass * (rolling * tanh(forward / _ROLLING_SPEED) + drag * abs(forward) * forward)
        across = front_x * sine + front_y * cosine
        return (
            front_x * cosine - front_y * sine + rear_x - resistance,
            across + rear_y,
            across * to_front - rear_y * to_rear,
        )

    return forces
