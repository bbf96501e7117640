"""Simulated people, seen from above as discs: they walk, turn, stop, and step out from behind obstacles.

They do not react to the robot, except when it touches them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from math import atan2, ceil, cos, hypot, inf, pi, sin
from typing import TYPE_CHECKING, final

import numpy as np

from safedpa.errors import InputError
from safedpa_sim.sensing.shapes import Outline, Point, clearance_at, clearances_at

if TYPE_CHECKING:
    from safedpa_sim.robots.car.scene import Scene

RADIUS = 0.2
"""m; radius of a person at the height of the laser."""

_RETAINED = 0.15
"""m of distance that a person keeps from stationary obstacles beyond their own radius."""
_LOOK_AHEAD = 0.6
"""s; a person who would be too close to an obstacle by then turns."""
_TURNS = 8


class Person(ABC):
    """A person at ``position`` [m] who moves in steps."""

    def __init__(self, position: Point, radius: float = RADIUS) -> None:
        self.position, self.radius = position, radius

    def touched(self, time: float) -> None:
        """Called while the person touches the robot or its load; the person must not push it."""
        del time

    @abstractmethod
    def velocity(self, time: float, robot: Point, outline: Outline) -> Point:
        """Returns the velocity [m/s] for the step at ``time`` [s], with the robot at ``robot`` among ``outline``."""


@final
class Walks(Person):
    """Walks straight on at up to ``speed`` [m/s] and randomly turns, pauses or changes pace."""

    def __init__(self, position: Point, speed: float, seed: int, radius: float = RADIUS) -> None:
        if not 0.0 <= speed <= 3.0:
            raise InputError(f"person's speed: got {speed}, wanted 0 to 3 m/s")
        super().__init__(position, radius)
        self._draw = np.random.default_rng([seed, 11])
        self._fastest = speed
        self._heading = float(self._draw.uniform(-pi, pi))
        self._pace, self._until = speed, 0.0
        self._waits = -inf

    def touched(self, time: float) -> None:
        """Turns round, and continues after a second."""
        if time >= self._waits:
            self._waits, self._heading = time + 1.0, self._heading + pi
            self._until = time + 2.0

    def velocity(self, time: float, robot: Point, outline: Outline) -> Point:  # noqa: D102
        del robot
        if self._waits - 1.0 <= time < self._waits - 0.2:
            return 0.0, 0.0
        if time >= self._until:
            self._until = time + float(self._draw.uniform(0.5, 3.0))
            stops = self._draw.random() < 0.2
            self._pace = 0.0 if stops else self._fastest * float(self._draw.uniform(0.4, 1.0))
            self._heading += float(self._draw.normal(0.0, 0.7))
        for _ in range(_TURNS):
            if self._is_free(outline):
                return self._pace * cos(self._heading), self._pace * sin(self._heading)
            self._heading += float(self._draw.uniform(-1.0, 1.0))
        return 0.0, 0.0

    def _is_free(self, outline: Outline) -> bool:
        """Returns whether the path ahead is free, checked in steps smaller than the radius so that none is missed."""
        way = self._pace * _LOOK_AHEAD
        steps = ceil(way / self.radius) + 1
        reaches = np.arange(1, steps + 1)[:, np.newaxis] * (way / steps)
        ahead = np.array((cos(self._heading), sin(self._heading)))
        return bool((clearances_at(outline, self.position + reaches * ahead) > self.radius + _RETAINED).all())


@final
class StepsOut(Person):
    """Waits until the robot is within ``trigger`` [m] of ``towards``, then walks there and beyond at ``speed``."""

    def __init__(self, position: Point, towards: Point, speed: float, trigger: float, radius: float = RADIUS) -> None:
        super().__init__(position, radius)
        self._towards, self._speed, self._trigger = towards, speed, trigger
        self._heading = atan2(towards[1] - position[1], towards[0] - position[0])
        self.stepped = False
        self._stopped = False

    def touched(self, time: float) -> None:
        """Stops permanently."""
        del time
        self._stopped = True

    def velocity(self, time: float, robot: Point, outline: Outline) -> Point:  # noqa: D102
        del time
        near = hypot(robot[0] - self._towards[0], robot[1] - self._towards[1]) < self._trigger
        self.stepped = self.stepped or near
        ahead = 0.1 * self._speed + self.radius
        x, y = self.position[0] + ahead * cos(self._heading), self.position[1] + ahead * sin(self._heading)
        if self._stopped or not self.stepped or clearance_at(outline, x, y) < 0.02:
            return 0.0, 0.0
        return self._speed * cos(self._heading), self._speed * sin(self._heading)


MOST_PEOPLE = 12
_ROOM = 0.4
"""m of free space around a person's centre at the start."""
_AWAY = 2.0
"""m; least distance between people and car at the start."""
_TRIES = 2000


def walkers(scene: Scene, count: int, speed: float = 1.5, draw: np.random.Generator | None = None) -> tuple[Walks, ...]:
    """Returns ``count`` people who walk at up to ``speed`` [m/s]; without ``draw`` they depend on the scene only.

    Raises InputError when the scene has no room for them.
    """
    outline = Outline(scene.obstacles, scene.polygons, (scene.field,))
    return walkers_in(outline, scene.field, (scene.start[0], scene.start[1]), count, scene.seed, speed, draw)


def walkers_in(
    outline: Outline,
    field: Sequence[float],
    start: Point,
    count: int,
    seed: int,
    speed: float = 1.5,
    draw: np.random.Generator | None = None,
) -> tuple[Walks, ...]:
    """Returns ``count`` people who walk in ``field`` [m], at least 2 m from ``start``.

    Raises InputError when there is no room for them.
    """
    draw = draw or np.random.default_rng([seed, 29])
    found = list[Walks]()
    for _ in range(_TRIES):
        if len(found) == count:
            return tuple(found)
        x, y = draw.uniform((field[0], field[2]), (field[1], field[3])).tolist()
        if clearance_at(outline, x, y) > _ROOM and hypot(x - start[0], y - start[1]) > _AWAY:
            found.append(Walks((x, y), speed, 100 * seed + len(found)))
    if len(found) == count:
        return tuple(found)
    raise InputError(f"people: got {count}, but the scene has room for {len(found)}; choose fewer")
