"""The car's barriers in one go: obstacles, field and speed limits over a geometry that is computed once a state."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin
from operator import is_
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.barrier import AbstractBarrier, AbstractStack, Barriers
from safedpa.safety.field_barrier import NORMALS, FieldBarrier
from safedpa.safety.obstacle_barrier import SMALLEST_DISTANCE, ObstacleBarrier
from safedpa.safety.speed_barrier import SpeedBarrier

__all__ = ["CarStack", "Stacks", "stacked"]

Values = NDArray[np.float64]

_STATES, _SPEED, _WALLS = 4, 3, 8


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


@final
class CarStack(AbstractStack):
    """Obstacles, field and speed limits of one body, with the same numbers as one by one.

    Heading, stopping distance and the ends of the segment are computed once for all of them, the obstacles' arrays
    live in buffers of this stack, and the gradient at the state whose values were asked for last begins where those
    ended. Not to be shared between threads.
    """

    def __init__(self, obstacles: ObstacleBarrier, field: FieldBarrier | None, speed: SpeedBarrier) -> None:
        super().__init__((obstacles, speed) if field is None else (obstacles, field, speed))
        self._obstacles, self._field, self._speed = obstacles, field, speed
        self._count = count = len(obstacles.names)
        self._turn, self._point = np.zeros((2, 2)), np.zeros((2, 1))
        self._apart, self._offset = np.zeros((2, count)), np.zeros((2, count))
        self._along, self._across = self._offset
        self._nearest, self._distance = np.zeros(count), np.zeros(count)
        self._rear, self._front = np.zeros(()), np.zeros(())
        """Ends of the segment, along the heading [m]."""
        self._slopes = np.zeros((_STATES, len(self.names)))
        """Of which only what depends on the state is written anew."""
        if field is not None:
            self._slopes[:2, count : count + _WALLS] = NORMALS
        self._slopes[_SPEED, -2:] = -1.0, 1.0
        self._at = b""
        """The state that the buffers belong to."""
        self._pose = (0.0,) * 7

    def values(self, state: Values) -> Values:  # noqa: D102
        if state.shape != (_STATES,):
            return self.one_by_one.values(state)
        x, y, cosine, sine, front, rear, speed = self._prepared(state)
        h = np.empty(len(self.names))
        np.subtract(self._distance, self._obstacles.reach, out=h[: self._count])
        field, limits = self._field, self._speed
        if field is None:
            h[self._count :] = limits.high - speed, speed - limits.low
            return h
        front_x, front_y, rear_x, rear_y = x + front * cosine, y + front * sine, x + rear * cosine, y + rear * sine
        h[self._count :] = (
            *(front_x - field.low_x, field.high_x - front_x, front_y - field.low_y, field.high_y - front_y),
            *(rear_x - field.low_x, field.high_x - rear_x, rear_y - field.low_y, field.high_y - rear_y),
            *(limits.high - speed, speed - limits.low),
        )
        return h

    def gradient(self, state: Values) -> Values:  # noqa: D102
        if state.shape != (_STATES,):
            return self.one_by_one.gradient(state)
        _, _, cosine, sine, front, rear, speed = self._prepared(state)
        slopes, count, slope = self._slopes.copy(), self._count, self._obstacles.braking.slope(speed)
        self._obstacle_slopes(slopes[:, :count], front, rear, speed, slope)
        if self._field is not None:
            forwards, backwards = slope if speed >= 0.0 else 0.0, slope if speed <= 0.0 else 0.0
            slopes[2, count : count + _WALLS] = (
                *(-front * sine, front * sine, front * cosine, -front * cosine),
                *(-rear * sine, rear * sine, rear * cosine, -rear * cosine),
            )
            slopes[3, count : count + _WALLS] = (
                *(forwards * cosine, -forwards * cosine, forwards * sine, -forwards * sine),
                *(backwards * cosine, -backwards * cosine, backwards * sine, -backwards * sine),
            )
        return slopes.T

    def _obstacle_slopes(self, slopes: Values, front: float, rear: float, speed: float, slope: float) -> None:
        """Writes d(h)/d(state) (states, obstacles)."""
        direction = self._offset / np.maximum(self._distance, SMALLEST_DISTANCE)
        if np.count_nonzero(self._distance) < self._count:  # on the segment itself there is no direction
            direction[1] += self._distance == 0.0
        stretched = self._nearest == (front if speed >= 0.0 else rear)
        if speed == 0.0:
            stretched |= self._nearest == rear
        np.matmul(-self._turn.T, direction, out=slopes[:2])
        np.multiply(self._nearest, -direction[1], out=slopes[2])
        np.multiply(direction[0], -slope * stretched, out=slopes[3])

    def _prepared(self, state: Values) -> tuple[float, ...]:
        """x, y, cosine and sine of the heading, front and rear end [m], speed; fills the obstacles' buffers."""
        if self._at == (known := state.tobytes()):
            return self._pose
        x, y, yaw, speed = state.tolist()
        obstacles, cosine, sine = self._obstacles, cos(yaw), sin(yaw)
        stretch = obstacles.braking.distance(speed)
        rear, front = -obstacles.rear + min(stretch, 0.0), obstacles.front + max(stretch, 0.0)
        self._at = b""  # until all of it is there
        self._turn[0] = cosine, sine
        self._turn[1] = -sine, cosine
        self._point[:, 0] = state[:2]
        self._rear[()], self._front[()] = rear, front
        np.subtract(obstacles.centres, self._point, out=self._apart)
        np.dot(self._turn, self._apart, out=self._offset)
        np.maximum(self._along, self._rear, out=self._nearest)
        np.minimum(self._nearest, self._front, out=self._nearest)
        np.subtract(self._along, self._nearest, out=self._along)
        np.hypot(self._along, self._across, out=self._distance)
        self._at, self._pose = known, (x, y, cosine, sine, front, rear, speed)
        return self._pose
