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

    Raises InputError when a side is not finite or the field is empty.
    """

    kind = "field"
    reads = ("x", "y", "yaw", "speed")
    names = tuple(
        f"{wall} wall, {end} end" for end in ("front", "rear") for wall in ("left", "right", "lower", "upper")
    )

    def __init__(
        self, field: Sequence[float], footprint: Sequence[float], braking: Braking, clearance: float = 0.0
    ) -> None:
        sides = tuple(float(side) for side in field)
        if len(sides) != 4 or not all(isfinite(side) for side in sides) or sides[0] >= sides[1] or sides[2] >= sides[3]:
            raise InputError(f"field: got {sides}, wanted lowest x < highest x, lowest y < highest y, finite, in m")
        if not (isfinite(clearance) and clearance >= 0.0):
            raise InputError(f"clearance: got {clearance}, wanted a finite number >= 0 in m")
        self.rear, self.front, radius = checked_footprint(footprint)
        self.braking = braking
        room = radius + clearance
        self.low_x, self.high_x = sides[0] + room, sides[1] - room
        self.low_y, self.high_y = sides[2] + room, sides[3] - room

    @property
    def body(self) -> tuple[float, float, Braking]:
        """Rear and front end [m] and how it brakes: what the swept segment follows from."""
        return self.rear, self.front, self.braking

    def values(self, state: Values) -> Values:  # noqa: D102
        return np.array(self._heights(state))

    def evaluate(self, state: Values) -> tuple[Values, Values]:  # noqa: D102
        yaw, speed = float(state[2]), float(state[3])
        c, s = cos(yaw), sin(yaw)
        stretch, slope = self.braking.distance(speed), self.braking.slope(speed)
        ends = (
            (self.front + max(stretch, 0.0), slope if speed >= 0.0 else 0.0),
            (-self.rear + min(stretch, 0.0), slope if speed <= 0.0 else 0.0),
        )
        turning, stretching = [], []
        for reach, change in ends:
            turning += [-reach * s, reach * s, reach * c, -reach * c]
            stretching += [change * c, -change * c, change * s, -change * s]
        columns = np.zeros((len(state), 8))  # transposed: its rows lie together and are quicker to fill
        columns[:2] = NORMALS
        columns[2], columns[3] = turning, stretching
        return np.array(self._heights(state)), columns.T

    def _heights(self, state: Values) -> list[float]:
        x, y, yaw, speed = state.tolist()[:4]
        c, s = cos(yaw), sin(yaw)
        stretch = self.braking.distance(speed)
        heights = []
        for reach in (self.front + max(stretch, 0.0), -self.rear + min(stretch, 0.0)):
            end_x, end_y = x + reach * c, y + reach * s
            heights += [end_x - self.low_x, self.high_x - end_x, end_y - self.low_y, self.high_y - end_y]
        return heights
