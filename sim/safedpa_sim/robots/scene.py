"""A scene: the field, obstacles that leave passages, a free start, and an endless sequence of goals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin

import numpy as np

from safedpa.errors import InputError
from safedpa_sim.robots.footprint import footprint
from safedpa_sim.robots.loads import Load, load_named

__all__ = ["GOAL_RADIUS", "Scene"]

GOAL_RADIUS = 0.3
"""m from the rear axle's middle to the goal at which it counts as reached."""

_CLEARANCE = 0.35
"""m beyond the footprint's radius that goals and start keep to obstacles."""
_WALL_CLEARANCE = 1.0
"""m beyond the footprint's radius that goals and start keep to walls: a car has to turn round there."""
_PASSAGE = 0.4
"""m of room beyond twice the footprint's radius between any two solid things."""
_LEG = 2.5
"""m; shortest way from one goal to the next."""
_BEHIND = 0.7
"""Share of goals for which a place behind an obstacle is looked for."""
_RADII = (0.2, 0.35)
"""m; smallest and largest obstacle."""
_TRIES = 400

Point = tuple[float, float]


@dataclass(frozen=True)
class Scene:
    """Where the car drives. Lengths in m; the field is (lowest x, highest x, lowest y, highest y)."""

    seed: int
    load: Load | None
    field: tuple[float, float, float, float]
    obstacles: tuple[tuple[float, float, float], ...]
    """x, y, radius of each."""
    start: tuple[float, float, float]
    """x, y, yaw of the rear axle's middle."""
    fixed_goals: tuple[Point, ...] = ()
    """Driven to in turn, again and again, instead of goals drawn from the seed."""
    polygons: tuple[tuple[Point, ...], ...] = ()
    """Corners of each thing with edges, convex and anticlockwise; goals and start are not drawn around them."""

    @property
    def footprint(self) -> tuple[float, float, float]:
        """Rear, front and radius of the capsule that must stay free."""
        return footprint(self.load)

    @classmethod
    def random(cls, seed: int, load: str = "none", obstacles: int = 6, size: float = 8.0) -> Scene:
        """The scene of a seed, on a square field of edge ``size`` centred at 0.

        Raises InputError when the field cannot hold so many obstacles with passages between them.
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
        """Another free pose to begin in: x, y [m], yaw [rad]. Raises InputError where there is none."""
        return _start(draw, self.field, self.obstacles, self.load)

    def goals(self) -> Iterator[Point]:
        """The goals in order, without end; the same ones at each call."""
        if self.fixed_goals:
            while True:
                yield from self.fixed_goals
        draw = np.random.default_rng([self.seed, 1])
        at: Point = self.start[:2]
        while True:
            at = self._next_goal(draw, at)
            yield at

    def _next_goal(self, draw: np.random.Generator, at: Point) -> Point:
        """A free place at least one leg away, often one behind an obstacle."""
        radius = self.footprint[2]
        free: list[Point] = []
        behind = draw.random() < _BEHIND
        for _ in range(_TRIES):
            place = _drawn(draw, self.field, radius + _WALL_CLEARANCE)
            if hypot(place[0] - at[0], place[1] - at[1]) < _LEG:
                continue
            if _clearance(place, self.obstacles) < radius + _CLEARANCE:
                continue
            free.append(place)
            if not behind or any(_distance_to_line(obstacle, at, place) < obstacle[2] for obstacle in self.obstacles):
                return place
            if len(free) == 20:
                break
        if not free:
            raise InputError("goals: no free place is left in the field; choose fewer obstacles or a larger field")
        return free[0]


def _placed(
    draw: np.random.Generator, field: tuple[float, float, float, float], count: int, gap: float
) -> tuple[tuple[float, float, float], ...] | None:
    """Obstacles with at least ``gap`` between each other and to the walls; None when they do not fit."""
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
    """A pose whose capsule, with the load straight behind, is free, and which looks towards the field's middle."""
    rear, front, radius = footprint(load)
    behind = rear + (load.drawbar + load.side if load else 0.0)
    for _ in range(100 * _TRIES):
        x, y = _drawn(draw, field, radius + _WALL_CLEARANCE)
        yaw = atan2(-y, -x) + float(draw.uniform(-pi / 3, pi / 3))
        back = (x - behind * cos(yaw), y - behind * sin(yaw))
        nose = (x + (front + 0.5) * cos(yaw), y + (front + 0.5) * sin(yaw))
        if all(_distance_to_line(other, back, nose) > other[2] + radius + _CLEARANCE for other in obstacles):
            return x, y, yaw
    raise InputError("start: no free place is left in the field; choose fewer obstacles or a larger field")


def _drawn(draw: np.random.Generator, field: tuple[float, float, float, float], clearance: float) -> Point:
    west, east, south, north = field
    if west + clearance > east - clearance or south + clearance > north - clearance:
        raise InputError(f"field: {field} leaves no place {clearance:.2f} m from its walls; choose a larger field")
    x, y = draw.uniform((west + clearance, south + clearance), (east - clearance, north - clearance))
    return float(x), float(y)


def _clearance(place: Point, obstacles: tuple[tuple[float, float, float], ...]) -> float:
    return min((hypot(place[0] - x, place[1] - y) - radius for x, y, radius in obstacles), default=float("inf"))


def _distance_to_line(obstacle: tuple[float, float, float], start: Point, end: Point) -> float:
    """From the obstacle's centre to the straight line between two points [m]."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    x, y = obstacle[0] - start[0], obstacle[1] - start[1]
    share = min(max((x * dx + y * dy) / (dx * dx + dy * dy), 0.0), 1.0)
    return hypot(x - share * dx, y - share * dy)
