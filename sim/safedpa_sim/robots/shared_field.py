"""Several simulated cars on one field, each the others' obstacle.

Every car keeps a world of its own, with the bodies of the others in it (``OtherBody``). They live in steps of the
physics: anyone who is furthest behind in time makes the next one, among the others where they are at that moment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

from safedpa.errors import InputError
from safedpa_sim.robots.contacts import Collision
from safedpa_sim.robots.core import CarRobot

__all__ = ["CarContact", "SharedField"]


@final
@dataclass(frozen=True)
class CarContact:
    """One contact of two cars, or of what they tow, counted once for both."""

    time: float
    """s since the start."""
    robots: tuple[int, int]
    """Which two, counted from 0; the one whose world noticed it comes first."""
    parts: tuple[str, str]
    """``car`` or ``load`` of each."""
    speeds: tuple[float, float]
    """m/s; how fast the centre of each part moved when they touched."""

    def __str__(self) -> str:
        first, other = (
            f"{part} of robot {robot} at {speed:.2f} m/s"
            for robot, part, speed in zip(self.robots, self.parts, self.speeds, strict=True)
        )
        return f"{first} against {other}, t={self.time:.2f} s"


@final
class SharedField:
    """Two or more cars that have not yet lived, in one field among the same things. Raises InputError for others.

    No one shoves anybody: who touches another car is stopped by it as by a wall, and one that stands stays where it is.
    """

    def __init__(self, robots: Sequence[CarRobot]) -> None:
        self.robots = tuple(robots)
        _check(self.robots)
        self.touches: list[CarContact] = []
        self._named: dict[str, tuple[int, str]] = {}
        """By the name of another's body: whose it is, and which part."""
        self._counted = [0] * len(self.robots)
        self._known = [0] * len(self.robots)
        """How many bodies of each car the others have in their worlds."""
        self._meet()

    def advance(self) -> None:
        """One period of all cars, each under the action that it accepted."""
        lives = [robot.lives() for robot in self.robots]
        due = {index: next(life) for index, life in enumerate(lives)}
        while due:
            index = min(due, key=lambda one: (due[one], one))
            self._surround(index, due[index])
            after = next(lives[index], None)
            if after is None:
                del due[index]
            else:
                due[index] = after
            self._count(index)
        self._meet()

    def collisions(self, index: int) -> list[Collision]:
        """Those of one car with what is no other car."""
        return [hit for hit in self.robots[index].collisions if hit.what not in self._named]

    def _meet(self) -> None:
        """Puts bodies that are new, such as a load that was hitched, into the worlds of all others."""
        for index, robot in enumerate(self.robots):
            bodies = robot.world.bodies
            for part, shape in bodies[self._known[index] :]:
                name = f"robot {index}" if part == "car" else f"{part} of robot {index}"
                self._named[name] = index, part
                for other in self.robots:
                    if other is not robot:
                        other.world.add_other(shape, name)
            self._known[index] = len(bodies)

    def _surround(self, index: int, now: float) -> None:
        """Moves the others in one car's world to where they are at ``now`` [s], by their own clocks a bit away."""
        world = self.robots[index].world
        for other in world.others:
            owner, _ = self._named[other.name]
            touches = any(world.contacts.lasts(part, other.name) for part in ("car", "load"))
            other.follow(now - self.robots[owner].world.time, touches=touches)

    def _count(self, index: int) -> None:
        """Takes up what is new of one car's contacts, unless the other one's world has noticed them before."""
        world = self.robots[index].world
        for hit in world.collisions[self._counted[index] :]:
            if hit.what not in self._named:
                continue
            other, part = self._named[hit.what]
            own_name = next(name for name, owned in self._named.items() if owned == (index, hit.part))
            if not self.robots[other].world.contacts.lasts(part, own_name):
                speed = next(body.speed for body in world.others if body.name == hit.what)
                self.touches.append(CarContact(hit.time, (index, other), (hit.part, part), (hit.speed, speed)))
        self._counted[index] = len(world.collisions)


def _check(robots: Sequence[CarRobot]) -> None:
    if len(robots) < 2:
        raise InputError(f"robots: got {len(robots)}, wanted two or more on one field")
    first = robots[0]
    for robot in robots:
        if robot.tick or robot.world.others:
            raise InputError("robots: got one that drove or shares a field already, wanted new ones")
        if robot.people:
            raise InputError(f"people: got {len(robot.people)} around one car, wanted none: the others meet no one")
        if robot.period != first.period:
            raise InputError(f"period: got {first.period} and {robot.period} s, wanted the same for all robots")
        scene, other = robot.scene, first.scene
        if (scene.field, scene.obstacles, scene.polygons) != (other.field, other.obstacles, other.polygons):
            raise InputError("scenes: got different ones, wanted one field with the same things for all robots")
