"""People, seen from above as discs: they walk, turn, stop, and step out from behind things. None looks at the robot.

Those who walk about in a scene begin where there is room for them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from math import atan2, ceil, cos, hypot, inf, pi, sin
from typing import TYPE_CHECKING, final

import numpy as np

from safedpa.errors import InputError
from safedpa_sim.sensing.shapes import Outline, Point, clearance_at, clearances_at

if TYPE_CHECKING:
    from safedpa_sim.robots.scene import Scene

__all__ = ["MOST_PEOPLE", "RADIUS", "Person", "StepsOut", "Walks", "walkers"]

RADIUS = 0.2
"""m; of a person's legs and hips at a laser's height."""

_RETAINED = 0.15
"""m that someone keeps to what is at rest beyond the own radius."""
_LOOK_AHEAD = 0.6
"""s; who would be too near to something by then turns."""
_TURNS = 8


class Person(ABC):
    """Someone at ``place`` [m] who moves in steps."""

    def __init__(self, place: Point, radius: float = RADIUS) -> None:
        self.place, self.radius = place, radius

    def touched(self, time: float) -> None:
        """Told while the robot, or what it tows, is touched: no one shoves it away."""
        del time

    @abstractmethod
    def velocity(self, time: float, robot: Point, outline: Outline) -> Point:
        """m/s along x and y over the coming step at ``time`` [s]; the robot is at ``robot``, rest in ``outline``."""


@final
class Walks(Person):
    """Walks straight on at ``speed`` [m/s], and now and then turns, stops for a while or changes pace."""

    def __init__(self, place: Point, speed: float, seed: int, radius: float = RADIUS) -> None:
        if not 0.0 <= speed <= 3.0:
            raise InputError(f"person's speed: got {speed}, wanted 0 to 3 m/s")
        super().__init__(place, radius)
        self._draw = np.random.default_rng([seed, 11])
        self._fastest = speed
        self._heading = float(self._draw.uniform(-pi, pi))
        self._pace, self._until = speed, 0.0
        self._waits = -inf

    def touched(self, time: float) -> None:
        """Turns round, and goes on after a second."""
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
        """Whether the way that is looked ahead leaves room everywhere; in steps that jump over nothing thin."""
        way = self._pace * _LOOK_AHEAD
        steps = ceil(way / self.radius) + 1
        reaches = np.arange(1, steps + 1)[:, np.newaxis] * (way / steps)
        ahead = np.array((cos(self._heading), sin(self._heading)))
        return bool((clearances_at(outline, self.place + reaches * ahead) > self.radius + _RETAINED).all())


@final
class StepsOut(Person):
    """Stands hidden until the robot is within ``trigger`` [m] of ``towards``, then walks there at ``speed`` and on."""

    def __init__(self, place: Point, towards: Point, speed: float, trigger: float, radius: float = RADIUS) -> None:
        super().__init__(place, radius)
        self._towards, self._speed, self._trigger = towards, speed, trigger
        self._heading = atan2(towards[1] - place[1], towards[0] - place[0])
        self.stepped = False
        self._stopped = False

    def touched(self, time: float) -> None:
        """Stops for good."""
        del time
        self._stopped = True

    def velocity(self, time: float, robot: Point, outline: Outline) -> Point:  # noqa: D102
        del time
        near = hypot(robot[0] - self._towards[0], robot[1] - self._towards[1]) < self._trigger
        self.stepped = self.stepped or near
        ahead = 0.1 * self._speed + self.radius
        x, y = self.place[0] + ahead * cos(self._heading), self.place[1] + ahead * sin(self._heading)
        if self._stopped or not self.stepped or clearance_at(outline, x, y) < 0.02:
            return 0.0, 0.0
        return self._speed * cos(self._heading), self._speed * sin(self._heading)


MOST_PEOPLE = 12
_ROOM = 0.4
"""m that someone has around the middle at first."""
_AWAY = 2.0
"""m from the car at which people begin."""
_TRIES = 2000


def walkers(scene: Scene, count: int, speed: float = 1.5, draw: np.random.Generator | None = None) -> tuple[Walks, ...]:
    """So many who walk at up to ``speed`` [m/s]; without ``draw`` the same for the same scene.

    Raises InputError where there is no room for so many.
    """
    draw = draw or np.random.default_rng([scene.seed, 29])
    outline, found = Outline(scene.obstacles, scene.polygons, (scene.field,)), list[Walks]()
    for _ in range(_TRIES):
        if len(found) == count:
            return tuple(found)
        x, y = draw.uniform((scene.field[0], scene.field[2]), (scene.field[1], scene.field[3])).tolist()
        if clearance_at(outline, x, y) > _ROOM and hypot(x - scene.start[0], y - scene.start[1]) > _AWAY:
            found.append(Walks((x, y), speed, 100 * scene.seed + len(found)))
    if len(found) == count:
        return tuple(found)
    raise InputError(f"people: got {count}, and the scene has room for {len(found)}; choose fewer")
