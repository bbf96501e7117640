"""The car's barriers in one go: obstacles, field and speed limits over a geometry that is computed once a state."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, sin
from operator import is_
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.barrier import AbstractBarrier, AbstractStack, Barriers
from safedpa.safety.field_barrier import FieldBarrier
from safedpa.safety.obstacle_barrier import SMALLEST_DISTANCE, ObstacleBarrier
from safedpa.safety.speed_barrier import SpeedBarrier

__all__ = ["CarStack", "Stacks", "stacked"]

Values = NDArray[np.float64]

Row = tuple[float, float, float, float]

_STATES, _SPEED = 4, 3


def stacked(parts: Sequence[AbstractBarrier]) -> AbstractStack:
    """The quickest stack of these barriers, in this order: ``CarStack`` for those of ``car_barriers``.

    Any others are asked one by one, which is the reference.
    """
    if isinstance(parts, AbstractStack):
        return parts
    if len(parts) in (2, 3):
        obstacles, field, speed = parts[0], parts[1] if len(parts) == 3 else None, parts[-1]
        if (
            isinstance(obstacles, ObstacleBarrier)
            and (field is None or isinstance(field, FieldBarrier))
            and isinstance(speed, SpeedBarrier)
            and (field is None or field.body == obstacles.body)
            and speed.index == _SPEED
        ):
            return CarStack(obstacles, field, speed)
    return Barriers(parts)


@final
class Stacks:
    """``stacked`` for parts that are mostly those of the last tick: their stack is kept."""

    def __init__(self) -> None:
        self._last: AbstractStack = Barriers(())

    def of(self, parts: Sequence[AbstractBarrier]) -> AbstractStack:
        """The stack of just these objects."""
        if isinstance(parts, AbstractStack):
            return parts
        known = self._last.parts
        if len(parts) != len(known) or not all(map(is_, parts, known)):
            self._last = stacked(parts)
        return self._last


class _Geometry(NamedTuple):
    """What all barriers at one state follow from; lengths in m."""

    x: float
    y: float
    speed: float
    cosine: float
    sine: float
    rear: float
    """End of the swept segment along the heading; so is ``front``."""
    front: float
    obstacles: list[tuple[float, float, float, float]]
    """Of each: what it lies ahead of and aside from the segment's nearest point, that point along the heading, and the
    distance from it."""


@final
class CarStack(AbstractStack):
    """Obstacles, field and speed limits of one body, with the same numbers as one by one, to rounding.

    Written over plain numbers: a service comes back to this after fifty milliseconds, and then the first call of each
    of numpy's functions costs several microseconds, a multiplication of two floats still nothing. The geometry at the
    state that was asked for last is kept, for the gradient there. Not to be shared between threads.
    """

    def __init__(self, obstacles: ObstacleBarrier, field: FieldBarrier | None, speed: SpeedBarrier) -> None:
        super().__init__((obstacles, speed) if field is None else (obstacles, field, speed))
        self._obstacles, self._field, self._speed = obstacles, field, speed
        self._places: list[tuple[float, float]] = list(zip(*obstacles.centres.tolist(), strict=True))
        self._reach: list[float] = obstacles.reach.tolist()
        self._at = b""
        """The state that the geometry belongs to."""
        self._geometry: _Geometry | None = None

    def values(self, state: Values) -> Values:  # noqa: D102
        if state.shape != (_STATES,):
            return self.one_by_one.values(state)
        x, y, speed, cosine, sine, rear, front, obstacles = self._seen_from(state)
        h = [seen[3] - reach for seen, reach in zip(obstacles, self._reach, strict=True)]
        field, limits = self._field, self._speed
        if field is not None:
            front_x, front_y, rear_x, rear_y = x + front * cosine, y + front * sine, x + rear * cosine, y + rear * sine
            h += (front_x - field.low_x, field.high_x - front_x, front_y - field.low_y, field.high_y - front_y)
            h += (rear_x - field.low_x, field.high_x - rear_x, rear_y - field.low_y, field.high_y - rear_y)
        h += (limits.high - speed, speed - limits.low)
        return np.array(h)

    def gradient(self, state: Values) -> Values:  # noqa: D102
        if state.shape != (_STATES,):
            return self.one_by_one.gradient(state)
        seen = self._seen_from(state)
        slope = self._obstacles.braking.slope(seen.speed)
        rows = [_obstacle_slopes(one, seen, slope) for one in seen.obstacles]
        if self._field is not None:
            forwards, backwards = slope if seen.speed >= 0.0 else 0.0, slope if seen.speed <= 0.0 else 0.0
            rows += _wall_slopes(seen, seen.front, forwards)
            rows += _wall_slopes(seen, seen.rear, backwards)
        rows += ((0.0, 0.0, 0.0, -1.0), (0.0, 0.0, 0.0, 1.0))
        return np.array(rows)

    def _seen_from(self, state: Values) -> _Geometry:
        if self._geometry is not None and self._at == state.tobytes():
            return self._geometry
        x, y, yaw, speed = state.tolist()
        body, cosine, sine = self._obstacles, cos(yaw), sin(yaw)
        stretch = body.braking.distance(speed)
        rear, front = -body.rear + min(stretch, 0.0), body.front + max(stretch, 0.0)
        obstacles = []
        for place_x, place_y in self._places:
            apart_x, apart_y = place_x - x, place_y - y
            along, across = cosine * apart_x + sine * apart_y, cosine * apart_y - sine * apart_x
            nearest = rear if along < rear else front if along > front else along
            obstacles.append((along - nearest, across, nearest, hypot(along - nearest, across)))
        self._at = state.tobytes()
        self._geometry = _Geometry(x, y, speed, cosine, sine, rear, front, obstacles)
        return self._geometry


def _obstacle_slopes(one: tuple[float, float, float, float], seen: _Geometry, slope: float) -> Row:
    """d(h)/d(state) of one obstacle."""
    along, across, nearest, distance = one
    size = max(distance, SMALLEST_DISTANCE)
    ahead, aside = along / size, across / size if distance else 1.0  # on the segment itself to the left is a direction
    end = seen.front if seen.speed >= 0.0 else seen.rear
    stretched = nearest == end or (seen.speed == 0.0 and nearest == seen.rear)
    cosine, sine = seen.cosine, seen.sine
    change = -slope * ahead if stretched else 0.0
    return sine * aside - cosine * ahead, -sine * ahead - cosine * aside, -nearest * aside, change


def _wall_slopes(seen: _Geometry, reach: float, change: float) -> tuple[Row, Row, Row, Row]:
    """d(h)/d(state) of the four walls at one end of the segment, which the speed moves by ``change``."""
    turn_x, turn_y = -reach * seen.sine, reach * seen.cosine
    grow_x, grow_y = change * seen.cosine, change * seen.sine
    return (
        (1.0, 0.0, turn_x, grow_x),
        (-1.0, 0.0, -turn_x, -grow_x),
        (0.0, 1.0, turn_y, grow_y),
        (0.0, -1.0, -turn_y, -grow_y),
    )
