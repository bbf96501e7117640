"""Obstacles, field and speed limits of a car over plain numbers: what the filter asks for several times a decision.

No arrays: a service comes back to this after fifty milliseconds, and then the first call of each of numpy's functions
costs several microseconds, a multiplication of two floats still nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, sin
from typing import final

from safedpa.safety.braking import Braking
from safedpa.safety.obstacle_barrier import SMALLEST_DISTANCE

__all__ = ["CarGeometry", "Row"]

Row = tuple[float, float, float, float]
"""Something of each entry of the state (x, y, yaw, speed)."""

_WALLS = 8


@final
class CarGeometry:
    """h and its slopes as in ``ObstacleBarrier``, ``FieldBarrier`` and ``SpeedBarrier``, in this order.

    ``obstacles``: x, y [m] and what the distance has to exceed [m]; ``field``: lowest and highest x, y of both ends of
    the swept segment [m], or None; ``limits``: lowest and highest speed [m/s]; ``body``: rear and front end [m].
    """

    def __init__(
        self,
        obstacles: list[tuple[float, float, float]],
        field: Row | None,
        limits: tuple[float, float],
        body: tuple[float, float],
        braking: Braking,
    ) -> None:
        self._obstacles, self._field, self._limits = obstacles, field, limits
        self._rear, self._front = body
        self._braking = braking

    def _ends(self, speed: float) -> tuple[float, float]:
        """Of the swept segment along the heading: rear and front [m]."""
        stretch: float = self._braking.distance(speed)
        if stretch > 0.0:
            return -self._rear, self._front + stretch
        return -self._rear + stretch, self._front

    def heights(self, state: Sequence[float]) -> list[float]:
        """h (m,) at ``state`` (x, y, yaw, speed)."""
        x, y, yaw, speed = state
        cosine, sine = cos(yaw), sin(yaw)
        rear, front = self._ends(speed)
        h: list[float] = []
        for place_x, place_y, reach in self._obstacles:
            apart_x, apart_y = place_x - x, place_y - y
            along, across = cosine * apart_x + sine * apart_y, cosine * apart_y - sine * apart_x
            nearest = rear if along < rear else front if along > front else along
            h.append(hypot(along - nearest, across) - reach)
        if self._field is not None:
            low_x, high_x, low_y, high_y = self._field
            front_x, front_y, rear_x, rear_y = x + front * cosine, y + front * sine, x + rear * cosine, y + rear * sine
            h += [front_x - low_x, high_x - front_x, front_y - low_y, high_y - front_y]
            h += [rear_x - low_x, high_x - rear_x, rear_y - low_y, high_y - rear_y]
        lowest, highest = self._limits
        h += [highest - speed, speed - lowest]
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> list[Row]:
        """d(h_i)/d(state) of the rows asked for."""
        x, y, yaw, speed = state
        cosine, sine = cos(yaw), sin(yaw)
        ends = self._ends(speed)
        slope: float = self._braking.slope(speed)
        count = len(self._obstacles)
        walls = _WALLS if self._field is not None else 0
        found: list[Row] = []
        for row in rows:
            if row < count:
                place_x, place_y, _ = self._obstacles[row]
                found.append(_obstacle_slopes(place_x - x, place_y - y, cosine, sine, ends, speed, slope))
            elif row < count + walls:
                found.append(_wall_slopes(row - count, cosine, sine, ends, speed, slope))
            else:
                found.append((0.0, 0.0, 0.0, -1.0 if row == count + walls else 1.0))
        return found

    def steepest(self, state: Sequence[float]) -> Row:
        """Of each entry of the state: no |d(h_i)/d(entry)| is greater at ``state``, whatever the row."""
        speed = state[3]
        rear, front = self._ends(speed)
        slope: float = self._braking.slope(speed)
        return 1.0, 1.0, max(-rear, front, rear, -front), max(slope, 1.0)


def _obstacle_slopes(
    apart_x: float, apart_y: float, cosine: float, sine: float, ends: tuple[float, float], speed: float, slope: float
) -> Row:
    """d(h)/d(state) of one obstacle whose centre lies (apart_x, apart_y) from the robot."""
    rear, front = ends
    along, across = cosine * apart_x + sine * apart_y, cosine * apart_y - sine * apart_x
    nearest = rear if along < rear else front if along > front else along
    along -= nearest
    distance: float = hypot(along, across)
    size = max(distance, SMALLEST_DISTANCE)
    ahead, aside = along / size, across / size if distance else 1.0  # on the segment itself to the left is a direction
    end = front if speed >= 0.0 else rear
    stretched = nearest == end or (speed == 0.0 and nearest == rear)
    change = -slope * ahead if stretched else 0.0
    return sine * aside - cosine * ahead, -sine * ahead - cosine * aside, -nearest * aside, change


def _wall_slopes(wall: int, cosine: float, sine: float, ends: tuple[float, float], speed: float, slope: float) -> Row:
    """d(h)/d(state) of one wall at one end of the segment, which the speed moves."""
    rear, front = ends
    reach = front if wall < 4 else rear
    moves = speed >= 0.0 if wall < 4 else speed <= 0.0
    change = slope if moves else 0.0
    sign = 1.0 if wall % 2 == 0 else -1.0
    if wall % 4 < 2:
        return sign, 0.0, -sign * reach * sine, sign * change * cosine
    return 0.0, sign, sign * reach * cosine, sign * change * sine
