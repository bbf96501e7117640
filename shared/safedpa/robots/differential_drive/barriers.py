"""The barriers of a differential drive: obstacles and walls around the area that it sweeps while both wheels brake.

Each wheel, w = speed -+ turn_rate track / 2, stops within a signed stopping distance s_left, s_right (``Braking``).
So the centre of the axle moves at most D = (s_left + s_right) / 2 along its path, while the heading turns by at most
T = |s_right - s_left| / track. Every point of the body then stays within

    the segment from p - (rear - min(D, 0)) e to p + (front + max(D, 0)) e, e = (cos yaw, sin yaw),
    thickened by the radius and by (L + |D|) T, L = max(|rear|, |front|):

because a path of length |D| with a heading error of at most T deviates by at most |D| T, and an end of the body at
distance L by L T more. While both wheels brake, D and T decrease and the rest of the path stays within the previous
region, so that no h decreases under braking.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.equations import Given
from safedpa.errors import InputError
from safedpa.operations import Operations, Scalar
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.equation import AbstractEquationBarrier
from safedpa.safety.barriers.limits import SpeedBarrier
from safedpa.safety.barriers.stopping import Braking, stopping_distance
from safedpa.safety.settings import FilterSettings

_STATES = ("x", "y", "yaw", "speed", "turn_rate")
_SPEED = 3


class Shape(NamedTuple):
    """The robot's dimensions in m."""

    rear: float
    """Extent behind the centre of the axle."""
    front: float
    radius: float
    track: float


class _Swept(NamedTuple):
    cosine: Scalar
    sine: Scalar
    rear: Scalar
    front: Scalar
    growth: Scalar


def _swept(given: Given, operations: Operations) -> _Swept:
    yaw, speed, turn = given.state[2], given.state[3], given.state[4]
    rear, front, deceleration, gain, track, arm = given.shared
    aside = 0.5 * track * turn
    left = stopping_distance(speed - aside, deceleration, gain, operations)
    right = stopping_distance(speed + aside, deceleration, gain, operations)
    stretch, turned = 0.5 * (left + right), operations.absolute(right - left) / track
    return _Swept(
        operations.cos(yaw),
        operations.sin(yaw),
        -rear + operations.minimum(stretch, 0.0),
        front + operations.maximum(stretch, 0.0),
        (arm + operations.absolute(stretch)) * turned,
    )


@final
class WheeledObstacleBarrier(AbstractEquationBarrier):
    """h_i = distance(c_i, swept segment) - (R_i + radius + clearance + (L + |D|) T), centre c_i, radius R_i [m].

    ``obstacles`` (m, 3): x, y, radius. Raises InputError for a wrong shape or a value that is not finite.
    """

    kind = "obstacle"
    reads = _STATES
    numbers = 3

    def __init__(self, obstacles: ArrayLike, shape: Shape, braking: Braking, clearance: float = 0.0) -> None:
        table = np.asarray(obstacles, dtype=np.float64)
        table = table.reshape(0, 3) if table.size == 0 else table
        if table.ndim != 2 or table.shape[1] != 3:
            raise InputError(f"obstacles: got shape {table.shape}, wanted (obstacles, 3): x, y, radius in m")
        if not np.isfinite(table).all() or (table[:, 2] < 0.0).any():
            raise InputError("obstacles: got NaN, infinity or a negative radius, wanted finite x, y, radius in m")
        self.names = tuple(f"obstacle {index}" for index in range(len(table)))
        self.shared = _shared(shape, braking)
        room = shape.radius + _checked(clearance)
        self.each = tuple((float(x), float(y), float(size) + room) for x, y, size in table)

    @staticmethod
    def equation(given: Given, operations: Operations) -> Sequence[Scalar]:
        """Returns h of an obstacle: x, y and required distance [m]."""
        x, y, reach = given.each
        swept = _swept(given, operations)
        apart_x, apart_y = x - given.state[0], y - given.state[1]
        along = swept.cosine * apart_x + swept.sine * apart_y
        across = swept.cosine * apart_y - swept.sine * apart_x
        beyond = along - operations.clip(along, swept.rear, swept.front)
        return (operations.hypot(beyond, across) - reach - swept.growth,)


@final
class WheeledFieldBarrier(AbstractEquationBarrier):
    """h = b - n . end - (radius + clearance + (L + |D|) T), both ends of the swept segment, four walls n . p <= b.

    ``field`` = lowest x, highest x, lowest y, highest y [m]. Raises InputError for an empty field or non-finite values.
    """

    kind = "field"
    reads = _STATES
    numbers = 4
    names = tuple(
        f"{wall} wall, {end} end" for end in ("front", "rear") for wall in ("left", "right", "lower", "upper")
    )

    def __init__(self, field: Sequence[float], shape: Shape, braking: Braking, clearance: float = 0.0) -> None:
        sides = tuple(float(side) for side in field)
        if len(sides) != 4 or not all(map(isfinite, sides)) or sides[0] >= sides[1] or sides[2] >= sides[3]:
            raise InputError(f"field: got {sides}, wanted lowest x < highest x, lowest y < highest y, finite, in m")
        room = shape.radius + _checked(clearance)
        self.shared = _shared(shape, braking)
        self.each = ((sides[0] + room, sides[1] - room, sides[2] + room, sides[3] - room),)

    @staticmethod
    def equation(given: Given, operations: Operations) -> Sequence[Scalar]:
        """Returns h of both ends for the four walls, which are already moved inwards by the required distance."""
        low_x, high_x, low_y, high_y = given.each
        swept, found = _swept(given, operations), list[Scalar]()
        for reach in (swept.front, swept.rear):
            x, y = given.state[0] + reach * swept.cosine, given.state[1] + reach * swept.sine
            found += [room - swept.growth for room in (x - low_x, high_x - x, y - low_y, high_y - y)]
        return found


def wheeled_barriers(
    settings: FilterSettings, shape: Shape, obstacles: ArrayLike, field: Sequence[float] = ()
) -> list[AbstractBarrier]:
    """Returns the barriers of obstacles (m, 3), the field (4,) if given, and the speed limits, for the five states.

    Raises InputError for a wrong shape or a value that is not finite.
    """
    braking = Braking(settings.barrier("braking_deceleration"), settings.barrier("braking_gain"))
    found: list[AbstractBarrier] = [WheeledObstacleBarrier(obstacles, shape, braking, settings.barrier("clearance"))]
    if len(field):
        found.append(WheeledFieldBarrier(field, shape, braking, settings.barrier("clearance")))
    return [*found, SpeedBarrier(settings.barrier("speed_low"), settings.barrier("speed_high"), _SPEED)]


def _shared(shape: Shape, braking: Braking) -> tuple[float, ...]:
    rear, front, radius, track = map(float, shape)
    if not all(map(isfinite, (rear, front, radius, track))) or radius < 0.0 or rear + front < 0.0 or track <= 0.0:
        raise InputError(
            f"footprint: got {tuple(shape)}, wanted finite rear, front, radius, track in m, radius >= 0, front not "
            "behind rear, track > 0"
        )
    return (rear, front, braking.deceleration, braking.gain, track, max(abs(rear), abs(front)))


def _checked(clearance: float) -> float:
    if not (isfinite(clearance) and clearance >= 0.0):
        raise InputError(f"clearance: got {clearance}, wanted a finite number >= 0 in m")
    return clearance
