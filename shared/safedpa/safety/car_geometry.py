"""Obstacles, field and speed limits of a car over plain numbers: what the filter asks for several times a decision.

No arrays: a service comes back to this after fifty milliseconds, and then the first call of each of numpy's functions
costs several microseconds, a multiplication of two floats still nothing. Numbers that belong together stand in lists
side by side and are looked up by their place, which is what costs least when this module is compiled.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, sin, sqrt
from typing import Final, final

from safedpa.safety.braking import Braking
from safedpa.safety.chain_rule import chain_rule
from safedpa.safety.obstacle_barrier import SMALLEST_DISTANCE
from safedpa.safety.towed_reach import TowedReach

__all__ = ["CarGeometry", "Row"]

Row = tuple[float, float, float, float]
"""Something of each entry of the state (x, y, yaw, speed)."""

_WALLS: Final = 8
_SMALLEST: Final[float] = SMALLEST_DISTANCE

_SMALL: Final = 1e-290
_LARGE: Final = 1e290
"""Between them the root of a sum of squares is as good as ``hypot``; beyond, squares are rounded away or infinite."""


@final
class CarGeometry:
    """h and its slopes as in ``ObstacleBarrier``, ``FieldBarrier`` and ``SpeedBarrier``, in this order.

    ``obstacles``: x, y [m] and what the distance has to exceed [m]; ``field``: lowest and highest x, y of both ends of
    the swept segment [m], or None; ``limits``: lowest and highest speed [m/s]; ``body``: rear and front end [m];
    ``towed``: what hangs at the rear end, if anything.
    """

    def __init__(
        self,
        obstacles: list[tuple[float, float, float]],
        field: Row | None,
        limits: tuple[float, float],
        body: tuple[float, float],
        braking: Braking,
        towed: TowedReach | None = None,
    ) -> None:
        self._towed = towed
        self._places_x: list[float] = [x for x, _, _ in obstacles]
        self._places_y: list[float] = [y for _, y, _ in obstacles]
        self._reaches: list[float] = [reach for _, _, reach in obstacles]
        self._walled = field is not None
        self._low_x, self._high_x, self._low_y, self._high_y = (0.0, 0.0, 0.0, 0.0) if field is None else field
        self._lowest, self._highest = limits
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
        x: float = state[0]
        y: float = state[1]
        yaw: float = state[2]
        speed: float = state[3]
        cosine, sine = cos(yaw), sin(yaw)
        rear, front = self._ends(speed)
        places_x, places_y, reaches = self._places_x, self._places_y, self._reaches
        h: list[float] = []
        for index in range(len(reaches)):
            apart_x, apart_y = places_x[index] - x, places_y[index] - y
            along, across = cosine * apart_x + sine * apart_y, cosine * apart_y - sine * apart_x
            if along < rear:
                along -= rear
            elif along > front:
                along -= front
            else:
                along = 0.0
            square = along * along + across * across
            distance = sqrt(square) if _SMALL < square < _LARGE else hypot(along, across)
            h.append(distance - reaches[index])
        if self._walled:
            for reach in (front, rear):
                end_x, end_y = x + reach * cosine, y + reach * sine
                h.append(end_x - self._low_x)
                h.append(self._high_x - end_x)
                h.append(end_y - self._low_y)
                h.append(self._high_y - end_y)
        h.append(self._highest - speed)
        h.append(speed - self._lowest)
        towed = self._towed
        if towed is not None:
            growth: float = towed.growth(x, y, speed)
            if growth > 0.0:
                self._lower(h, (x, y, cosine, sine), rear, growth)
        return h

    def _lower(self, h: list[float], pose: Row, rear: float, growth: float) -> None:
        """To what the larger radius from ``rear`` to the hitch leaves, at ``pose`` (x, y, cos yaw, sin yaw)."""
        x, y, cosine, sine = pose
        count = len(self._reaches)
        for row in range(count):
            apart_x, apart_y = self._places_x[row] - x, self._places_y[row] - y
            h[row] = min(
                h[row], _to_hitch(apart_x, apart_y, cosine, sine, rear, -self._rear) - self._reaches[row] - growth
            )
        if self._walled:
            sides = self._sides(x - self._rear * cosine, y - self._rear * sine)
            for wall in range(4):
                row = count + 4 + wall
                h[row] = min(h[row], sides[wall]) - growth

    def _sides(self, x: float, y: float) -> Row:
        """How far a point lies within each of the four walls [m]."""
        return x - self._low_x, self._high_x - x, y - self._low_y, self._high_y - y

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> list[Row]:
        """d(h_i)/d(state) of the rows asked for."""
        towed = self._towed
        if towed is not None:
            growth: float = towed.growth(state[0], state[1], state[3])
            if growth > 0.0:
                return [self._slope_towing(state, row, growth, towed) for row in rows]
        return self._slopes(state, rows)

    def _slope_towing(self, state: Sequence[float], row: int, growth: float, towed: TowedReach) -> Row:
        """The slope of one row where the radius at the hitch is the larger one."""
        x: float = state[0]
        y: float = state[1]
        yaw: float = state[2]
        speed: float = state[3]
        slope: Row = self._slopes(state, (row,))[0]
        cosine, sine = cos(yaw), sin(yaw)
        rear, front = self._ends(speed)
        hitch, count = -self._rear, len(self._reaches)
        if row < count:
            apart_x, apart_y = self._places_x[row] - x, self._places_y[row] - y
            whole = _to_hitch(apart_x, apart_y, cosine, sine, rear, front)
            if not _to_hitch(apart_x, apart_y, cosine, sine, rear, hitch) - growth < whole:
                return slope
            change = self._braking.slope(speed) if speed < 0.0 else 0.0
            slope = _obstacle_slopes(apart_x, apart_y, cosine, sine, rear, hitch, min(speed, -0.0), change)
        elif self._walled and 4 <= row - count < _WALLS:
            wall = row - count - 4
            if (
                self._sides(x + hitch * cosine, y + hitch * sine)[wall]
                < self._sides(x + rear * cosine, y + rear * sine)[wall]
            ):
                slope = _wall_slopes(wall + 4, cosine, sine, hitch, front, speed, 0.0)
        else:
            return slope
        grows = towed.slopes(x, y, speed)
        return slope[0] - grows[0], slope[1] - grows[1], slope[2], slope[3] - grows[2]

    def _slopes(self, state: Sequence[float], rows: Sequence[int]) -> list[Row]:
        """The same without what is towed."""
        x: float = state[0]
        y: float = state[1]
        yaw: float = state[2]
        speed: float = state[3]
        cosine, sine = cos(yaw), sin(yaw)
        rear, front = self._ends(speed)
        slope = self._braking.slope(speed)
        count = len(self._reaches)
        walls = _WALLS if self._walled else 0
        found: list[Row] = []
        for row in rows:
            if row < count:
                apart_x, apart_y = self._places_x[row] - x, self._places_y[row] - y
                found.append(_obstacle_slopes(apart_x, apart_y, cosine, sine, rear, front, speed, slope))
            elif row < count + walls:
                found.append(_wall_slopes(row - count, cosine, sine, rear, front, speed, slope))
            else:
                found.append((0.0, 0.0, 0.0, -1.0 if row == count + walls else 1.0))
        return found

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """d(h_i)/d(a_j) of the rows asked for, where the state moves by g (states, actions) a."""
        return chain_rule(self.slopes(state, rows), g)

    def steepest(self, state: Sequence[float]) -> Row:
        """Of each entry of the state: no |d(h_i)/d(entry)| is greater at ``state``, whatever the row."""
        speed: float = state[3]
        ends = self._ends(speed)
        slope = self._braking.slope(speed)
        rear, front = abs(ends[0]), abs(ends[1])
        towed = self._towed
        rate: float = 0.0 if towed is None else towed.rate
        steepest = slope * (1.0 + rate)
        return 1.0 + rate, 1.0 + rate, rear if rear > front else front, steepest if steepest > 1.0 else 1.0


def _to_hitch(apart_x: float, apart_y: float, cosine: float, sine: float, rear: float, front: float) -> float:
    """Distance [m] of a point (apart_x, apart_y) from the robot to the segment from ``rear`` to ``front``."""
    along, across = cosine * apart_x + sine * apart_y, cosine * apart_y - sine * apart_x
    nearest = rear if along < rear else front if along > front else along
    return hypot(along - nearest, across)


def _obstacle_slopes(
    apart_x: float, apart_y: float, cosine: float, sine: float, rear: float, front: float, speed: float, slope: float
) -> Row:
    """d(h)/d(state) of one obstacle whose centre lies (apart_x, apart_y) from the robot."""
    along, across = cosine * apart_x + sine * apart_y, cosine * apart_y - sine * apart_x
    nearest = rear if along < rear else front if along > front else along
    along -= nearest
    square = along * along + across * across
    distance = sqrt(square) if _SMALL < square < _LARGE else hypot(along, across)
    size = distance if distance > _SMALLEST else _SMALLEST
    ahead, aside = along / size, across / size if distance else 1.0  # on the segment itself to the left is a direction
    end = front if speed >= 0.0 else rear
    stretched = nearest == end or (speed == 0.0 and nearest == rear)
    change = -slope * ahead if stretched else 0.0
    return sine * aside - cosine * ahead, -sine * ahead - cosine * aside, -nearest * aside, change


def _wall_slopes(wall: int, cosine: float, sine: float, rear: float, front: float, speed: float, slope: float) -> Row:
    """d(h)/d(state) of one wall at one end of the segment, which the speed moves."""
    reach = front if wall < 4 else rear
    moves = speed >= 0.0 if wall < 4 else speed <= 0.0
    change = slope if moves else 0.0
    sign = 1.0 if wall % 2 == 0 else -1.0
    if wall % 4 < 2:
        return sign, 0.0, -sign * reach * sine, sign * change * cosine
    return 0.0, sign, sign * reach * cosine, sign * change * sine
