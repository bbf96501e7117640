"""The capsule around the car that must stay free of obstacles, so that neither body nor load touches anything."""

from __future__ import annotations

from math import ceil, hypot, sqrt, tan

from safedpa_sim.robots.car.loads import Load
from safedpa_sim.robots.car.parameters import CAR_PARAMETERS, CarParameters

_BEGINS, _ENDS = 0.2, 0.8
"""Shares of the reach. If the car reverses by less than the first, a load does not leave the footprint; by more than
the second, it may be anywhere around the hitch. Measured with random forward and backward drives: docs/robot.md."""


def footprint(load: Load | None, parameters: CarParameters = CAR_PARAMETERS) -> tuple[float, float, float]:
    """Returns (rear, front, radius) [m] of the capsule: all points within ``radius`` of the line from ``rear`` behind
    to ``front`` ahead of the rear axle's centre, along the heading.

    Without a load the line has the body's length and the radius is half its width, so that the corners lie exactly on
    the capsule. With a load the radius is the off-tracking of the load's centre in a turn plus half the load's
    diagonal,

        radius = R - sqrt(R^2 - l^2) + side / sqrt(2),
        R = wheelbase / tan(steer_limit),   l = rear + drawbar + side / 2,

    rounded up to 1 cm. While the car drives forwards, the load stays within the region that the capsule has swept.
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
    """Returns (begin, end, reach) [m] for the state message; empty without a load.

    ``reach`` = hypot(drawbar + side, side / 2), rounded up to 1 cm, is the distance of the farthest corner from the
    hitch: a disc of that radius contains the load at any angle. The filter starts to enlarge the footprint after
    reversing by ``begin`` and uses the full disc from ``end`` on.
    """
    if load is None:
        return ()
    reach = ceil(100 * hypot(load.drawbar + load.side, load.side / 2)) / 100
    return _BEGINS * reach, _ENDS * reach, reach
