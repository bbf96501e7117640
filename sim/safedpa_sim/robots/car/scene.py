"""Scenes of the car: field, obstacles with passages between them, a free start pose, and an endless goal sequence."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin

import numpy as np

from safedpa.errors import InputError
from safedpa_sim.robots.car.loads import Load, footprint, load_named

GOAL_RADIUS = 0.3
"""m from the rear axle's centre to the goal at which it counts as reached."""

_CLEARANCE = 0.35
"""m of distance from goals and start to obstacles beyond the footprint's radius."""
_WALL_CLEARANCE = 1.0
"""m of distance from goals and start to walls beyond the footprint's radius: the car has to turn round there."""
_PASSAGE = 0.4
"""m of room between any two solid objects beyond twice the footprint's radius."""
_LEG = 2.5
"""m; least distance from one goal to the next."""
_BEHIND = 0.7
"""Share of goals that are placed behind an obstacle if possible."""
_RADII = (0.2, 0.35)
"""m; smallest and largest obstacle."""
_TRIES = 400

Point = tuple[float, float]


@dataclass(frozen=True)
class Scene:
    """The surroundings and goals of one drive. Lengths in m; field is (min x, max x, min y, max y)."""

    seed: int
    load: Load | None
    field: tuple[float, float, float, float]
    obstacles: tuple[tuple[float, float, float], ...]
    """x, y, radius of each."""
    start: tuple[float, float, float]
    """x, y, yaw of the rear axle's centre."""
    fixed_goals: tuple[Point, ...] = ()
    """Goals that are visited cyclically, instead of goals drawn from the seed."""
    polygons: tuple[tuple[Point, ...], ...] = ()
    """Corners of polygonal obstacles, convex and anticlockwise. Random goals and starts do not avoid them."""

    @property
    def footprint(self) -> tuple[float, float, float]:
        """Rear, front and radius [m] of the capsule that must stay free."""
        return footprint(self.load)

    @classmethod
    def random(cls, seed: int, load: str = "none", obstacles: int = 6, size: float = 8.0) -> Scene:
        """Returns the scene of a seed, on a square field of edge ``size`` centred at 0.

        Raises InputError when the obstacles with passages between them do not fit the field.
        """
        towed, half = load_named(load), size / 2
        field = (-half, half, -half, half)
        radius = footprint(towed)[2]
        draw = np.random.default_rng([seed, 0])
        passage = 2 * radius + _PASSAGE
        placed = _placed(draw, field, obstacles, passage)
        if placed is None:
            raise InputError(
                f"obstacles: {obstacles} with passages of {passage:.2f} m do not fit a field of {size} m; "
                "choose fewer obstacles, a larger field or a smaller load"
            )
        return cls(seed, towed, field, placed, _start(draw, field, placed, towed))

    def drawn_start(self, draw: np.random.Generator) -> tuple[float, float, float]:
        """Draws another free start pose: x, y [m], yaw [rad]. Raises InputError when there is none."""
        return _start(draw, self.field, self.obstacles, self.load)

    def goals(self) -> Iterator[Point]:
        """Yields the goals in order, without end; the same ones at each call."""
        if self.fixed_goals:
            while True:
                yield from self.fixed_goals
        draw = np.random.default_rng([self.seed, 1])
        at: Point = self.start[:2]
        while True:
            at = self._next_goal(draw, at)
            yield at

    def _next_goal(self, draw: np.random.Generator, at: Point) -> Point:
        """Draws a free position at least ``_LEG`` away, often one behind an obstacle."""
        radius = self.footprint[2]
        free: list[Point] = []
        behind = draw.random() < _BEHIND
        for _ in range(_TRIES):
            drawn = _drawn(draw, self.field, radius + _WALL_CLEARANCE)
            if hypot(drawn[0] - at[0], drawn[1] - at[1]) < _LEG:
                continue
            if _clearance(drawn, self.obstacles) < radius + _CLEARANCE:
                continue
            free.append(drawn)
            if not behind or any(_distance_to_line(obstacle, at, drawn) < obstacle[2] for obstacle in self.obstacles):
                return drawn
            if len(free) == 20:
                break
        if not free:
            raise InputError("goals: no free position is left in the field; choose fewer obstacles or a larger field")
        return free[0]


def _placed(
    draw: np.random.Generator, field: tuple[float, float, float, float], count: int, gap: float
) -> tuple[tuple[float, float, float], ...] | None:
    """Draws obstacles with at least ``gap`` between each other and to the walls; None when they do not fit."""
    for _ in range(100):
        placed: list[tuple[float, float, float]] = []
        for _ in range(_TRIES):
            if len(placed) == count:
                return tuple(placed)
            radius = float(draw.uniform(*_RADII))
            x, y = _drawn(draw, field, gap + radius)
            if all(hypot(x - ox, y - oy) >= gap + radius + other for ox, oy, other in placed):
                placed.append((x, y, radius))
        if len(placed) == count:
            return tuple(placed)
    return None


def _start(
    draw: np.random.Generator,
    field: tuple[float, float, float, float],
    obstacles: tuple[tuple[float, float, float], ...],
    load: Load | None,
) -> tuple[float, float, float]:
    """Draws a start pose that faces the middle of the field and is free, including the load straight behind."""
    rear, front, radius = footprint(load)
    behind = rear + (load.drawbar + load.side if load else 0.0)
    for _ in range(100 * _TRIES):
        x, y = _drawn(draw, field, radius + _WALL_CLEARANCE)
        yaw = atan2(-y, -x) + float(draw.uniform(-pi / 3, pi / 3))
        back = (x - behind * cos(yaw), y - behind * sin(yaw))
        nose = (x + (front + 0.5) * cos(yaw), y + (front + 0.5) * sin(yaw))
        if all(_distance_to_line(other, back, nose) > other[2] + radius + _CLEARANCE for other in obstacles):
            return x, y, yaw
    raise InputError("start: no free position is left in the field; choose fewer obstacles or a larger field")


def _drawn(draw: np.random.Generator, field: tuple[float, float, float, float], clearance: float) -> Point:
    west, east, south, north = field
    if west + clearance > east - clearance or south + clearance > north - clearance:
        raise InputError(f"field: {field} leaves no position {clearance:.2f} m from its walls; choose a larger field")
    x, y = draw.uniform((west + clearance, south + clearance), (east - clearance, north - clearance))
    return float(x), float(y)


def _clearance(position: Point, obstacles: tuple[tuple[float, float, float], ...]) -> float:
    return min((hypot(position[0] - x, position[1] - y) - radius for x, y, radius in obstacles), default=float("inf"))


def _distance_to_line(obstacle: tuple[float, float, float], start: Point, end: Point) -> float:
    """Returns the distance from the obstacle's centre to the line segment between two points [m]."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    x, y = obstacle[0] - start[0], obstacle[1] - start[1]
    share = min(max((x * dx + y * dy) / (dx * dx + dy * dy), 0.0), 1.0)
    return hypot(x - share * dx, y - share * dy)
