"""The walls of a rectangular field around a robot whose body is a capsule, stretched by its stopping distance."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, isfinite, sin
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.braking import Braking
from safedpa.safety.obstacle_barrier import checked_footprint
from safedpa.safety.towed_reach import TowedReach

__all__ = ["NORMALS", "FieldBarrier"]

Values = NDArray[np.float64]

NORMALS = np.array(((1.0, -1.0, 0.0, 0.0) * 2, (0.0, 0.0, 1.0, -1.0) * 2))
"""d(h)/d(x, y) (2, 8): the walls' inward normals, for both ends."""


@final
class FieldBarrier(AbstractBarrier):
    """h = b - n . end - (r + clearance), for both ends of the swept segment and each of four walls n . p <= b.

    ``field`` = lowest x, highest x, lowest y, highest y [m]; state, footprint and stretched ends as in ObstacleBarrier.
    Eight barriers; the segment lies within a half plane exactly when both of its ends do. An end at p + t e gives

        d(h)/d(p) = -n,   d(h)/d(yaw) = -t n . e',   d(h)/d(speed) = -D' n . e at a stretched end.

    With something ``towed`` the radius at the rear end is larger by its growth, all the way that a reversing stop lets
    that end pass: the nearer end of this way counts.
    Raises InputError when a side is not finite or the field is empty.
    """

    kind = "field"
    reads = ("x", "y", "yaw", "speed")
    names = tuple(
        f"{wall} wall, {end} end" for end in ("front", "rear") for wall in ("left", "right", "lower", "upper")
    )

    def __init__(
        self,
        field: Sequence[float],
        footprint: Sequence[float],
        braking: Braking,
        clearance: float = 0.0,
        towed: TowedReach | None = None,
    ) -> None:
        sides = tuple(float(side) for side in field)
        if len(sides) != 4 or not all(isfinite(side) for side in sides) or sides[0] >= sides[1] or sides[2] >= sides[3]:
            raise InputError(f"field: got {sides}, wanted lowest x < highest x, lowest y < highest y, finite, in m")
        if not (isfinite(clearance) and clearance >= 0.0):
            raise InputError(f"clearance: got {clearance}, wanted a finite number >= 0 in m")
        self.rear, self.front, radius = checked_footprint(footprint)
        self.braking, self.towed = braking, towed
        room = radius + clearance
        self.low_x, self.high_x = sides[0] + room, sides[1] - room
        self.low_y, self.high_y = sides[2] + room, sides[3] - room

    @property
    def body(self) -> tuple[float, float, Braking, TowedReach | None]:
        """Rear and front end [m], how it brakes and what it tows: what the swept segment follows from."""
        return self.rear, self.front, self.braking, self.towed

    def evaluate(self, state: Values) -> tuple[Values, Values]:  # noqa: D102
        x, y, yaw, speed = state.tolist()[:4]
        c, s = cos(yaw), sin(yaw)
        stretch, slope = self.braking.distance(speed), self.braking.slope(speed)
        columns = np.zeros((len(state), 8))  # transposed: its rows lie together and are quicker to fill
        columns[:2] = NORMALS
        h = self._ends(state, self.front + max(stretch, 0.0), -self.rear + min(stretch, 0.0))
        columns[2:4] = _turning(self.front + max(stretch, 0.0), slope if speed >= 0.0 else 0.0, c, s)
        columns[2:4, 4:] = _turning(-self.rear + min(stretch, 0.0), slope if speed <= 0.0 else 0.0, c, s)[:, 4:]
        growth = 0.0 if self.towed is None else self.towed.growth(x, y, speed)
        if self.towed is not None and growth > 0.0:
            hitch = self._ends(state, -self.rear, -self.rear)[4:]
            columns[2:4, 4:] = np.where(hitch < h[4:], _turning(-self.rear, 0.0, c, s)[:, 4:], columns[2:4, 4:])
            h[4:] = np.minimum(h[4:], hitch) - growth
            columns[[0, 1, 3], 4:] -= np.array(self.towed.slopes(x, y, speed))[:, np.newaxis]
        return h, columns.T

    def values(self, state: Values) -> Values:  # noqa: D102
        x, y, _, speed = state.tolist()[:4]
        stretch = self.braking.distance(speed)
        h = self._ends(state, self.front + max(stretch, 0.0), -self.rear + min(stretch, 0.0))
        growth = 0.0 if self.towed is None else self.towed.growth(x, y, speed)
        if growth > 0.0:
            h[4:] = np.minimum(h[4:], self._ends(state, -self.rear, -self.rear)[4:]) - growth
        return h

    def _ends(self, state: Values, front: float, rear: float) -> Values:
        """h of two points, ``front`` and ``rear`` ahead of the reference point [m]."""
        x, y, yaw, _ = state.tolist()[:4]
        c, s = cos(yaw), sin(yaw)
        heights = []
        for reach in (front, rear):
            end_x, end_y = x + reach * c, y + reach * s
            heights += [end_x - self.low_x, self.high_x - end_x, end_y - self.low_y, self.high_y - end_y]
        return np.array(heights)


def _turning(reach: float, change: float, c: float, s: float) -> Values:
    """d(h)/d(yaw, speed) (2, 8) of an end ``reach`` ahead that the speed stretches by ``change``, twice."""
    turning = (-reach * s, reach * s, reach * c, -reach * c) * 2
    return np.array((turning, (change * c, -change * c, change * s, -change * s) * 2))
