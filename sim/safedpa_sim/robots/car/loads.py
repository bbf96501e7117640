"""Loads that the car can tow: square objects on a rigid drawbar, dragged over the floor on feet and runners.

``footprint`` is the capsule around the car that must stay free of obstacles, so that neither body nor load touches
anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, hypot, sqrt, tan

from safedpa.errors import InputError, did_you_mean
from safedpa_sim.robots.car.parameters import CAR_PARAMETERS, CarParameters


@dataclass(frozen=True)
class Load:
    """A square load on a drawbar. Sizes and masses are assumed: household objects scaled to a 2.5 kg car."""

    name: str
    mass_ratio: float
    """Mass of the load over mass of the car."""
    deceleration: float
    """m/s2; friction coefficient times gravity."""
    grip: float
    """m/s2; largest lateral force of its runners over its mass. Without runners the chair swings out in fast turns and
    spins the car."""
    side: float
    """m; length and width."""
    drawbar: float = 0.15
    """m from the hitch to the load's near edge; rigid with the load."""

    @property
    def length(self) -> float:
        """Distance from the hitch to the load's centre [m]."""
        return self.drawbar + self.side / 2


LOADS: dict[str, Load] = {
    load.name: load
    for load in (
        Load("box", mass_ratio=0.4, deceleration=2.5, grip=6.0, side=0.25),
        Load("chair", mass_ratio=0.8, deceleration=1.5, grip=6.0, side=0.35),
        Load("large_chair", mass_ratio=1.3, deceleration=1.6, grip=6.0, side=0.45),
    )
}
"""Every load by name; the name ``none`` means driving without a load."""


def load_named(name: str) -> Load | None:
    """Returns the load of that name, None for ``none``. Raises InputError listing the known names."""
    if name == "none":
        return None
    if name not in LOADS:
        raise InputError(f"load '{name}': {did_you_mean(name, ['none', *LOADS])}")
    return LOADS[name]


_BEGINS, _ENDS = 0.2, 0.8
"""Shares of the reach. If the car reverses by less than the first, a load does not leave the footprint; by more than
the second, it may be anywhere around the hitch. Measured with random forward and backward drives
(docs/reference/robot.md)."""


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
