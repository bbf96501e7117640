"""The capsule around the car that must stay free, so that neither body nor load touches anything."""

from __future__ import annotations

from math import ceil, hypot, sqrt, tan

from safedpa_sim.robots.car_parameters import CAR_PARAMETERS, CarParameters
from safedpa_sim.robots.loads import Load

__all__ = ["footprint", "towed_reach"]

_BEGINS, _ENDS = 0.2, 0.8
"""Of the reach: pushed back by less, a load does not leave the footprint; by more, it may stand anywhere around the
hitch. Measured with random programmes of forwards and backwards: docs/robot.md."""


def footprint(load: Load | None, parameters: CarParameters = CAR_PARAMETERS) -> tuple[float, float, float]:
    """(rear, front, radius) [m]: all points within ``radius`` of the line from ``rear`` behind to ``front`` ahead of
    the rear axle's middle, along the heading.

    Body alone: the line has the body's length and the radius is half its width, so that its corners lie exactly on the
    capsule. With a load the radius is what the load's centre cuts a corner by, plus half the load's diagonal,

        radius = R - sqrt(R^2 - l^2) + side / sqrt(2),
        R = wheelbase / tan(steer_limit),   l = rear + drawbar + side / 2,

    rounded up to 1 cm: while the car drives forwards, the load stays within the region that the capsule has passed.
    """
    car = parameters
    radius = car.width / 2
    if load is not None:
        tightest = car.wheelbase / tan(car.steer_limit)
        behind = car.rear + load.length
        cut = tightest - sqrt(tightest**2 - behind**2)
        radius = max(radius, ceil(100 * (cut + hypot(load.side, load.side) / 2)) / 100)
    return car.rear, car.front, radius


def towed_reach(load: Load | None) -> tuple[float, ...]:
    """(begin, end, reach) [m] as a state message tells them; empty without a load.

    The farthest corner is ``reach`` = hypot(drawbar + side, side / 2) from the hitch, rounded up to 1 cm: a disc of
    that radius holds the load at any angle. The whole of it is claimed after ``end``, nearly its own reach: pushed back
    by so much, it has left the place where it was.
    """
    if load is None:
        return ()
    reach = ceil(100 * hypot(load.drawbar + load.side, load.side / 2)) / 100
    return _BEGINS * reach, _ENDS * reach, reach
