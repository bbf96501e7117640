"""Several simulated cars on one field, each the others' obstacle.

Each car has its own world, which contains copies of the other cars' bodies (``OtherBody``). The worlds advance in steps
of the physics: the car that is furthest behind in time makes the next step, with the others at their pose of that time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

from safedpa.errors import InputError
from safedpa_sim.robots.car.contacts import Collision
from safedpa_sim.robots.car.robot import CarRobot


@final
@dataclass(frozen=True)
class CarContact:
    """One contact of two cars or their loads, counted once for both."""

    time: float
    """s since the start."""
    robots: tuple[int, int]
    """Indices of the two cars; the car whose world detected the contact comes first."""
    parts: tuple[str, str]
    """``car`` or ``load`` of each."""
    speeds: tuple[float, float]
    """m/s; speed of each part's centre at the contact."""

    def __str__(self) -> str:
        first, other = (
            f"{part} of robot {robot} at {speed:.2f} m/s"
            for robot, part, speed in zip(self.robots, self.parts, self.speeds, strict=True)
        )
        return f"{first} against {other}, t={self.time:.2f} s"


@final
class SharedField:
    """Two or more new cars on one field with the same obstacles. Raises InputError for cars that do not qualify.

    Cars do not push each other: a car that touches another one is stopped as by a wall, and a stationary car stays.
    """

    def __init__(self, robots: Sequence[CarRobot]) -> None:
        self.robots = tuple(robots)
        _check(self.robots)
        self.touches: list[CarContact] = []
        self._named: dict[str, tuple[int, str]] = {}
        """By the name of a copied body: index of its car, and the part."""
        self._counted = [0] * len(self.robots)
        self._known = [0] * len(self.robots)
        """Number of bodies of each car that are already copied into the other worlds."""
        self._meet()

    def advance(self) -> None:
        """Advances all cars by one period, each under its accepted action."""
        steps = [robot.advance_in_steps() for robot in self.robots]
        due = {index: next(times) for index, times in enumerate(steps)}
        while due:
            index = min(due, key=lambda one: (due[one], one))
            self._surround(index, due[index])
            after = next(steps[index], None)
            if after is None:
                del due[index]
            else:
                due[index] = after
            self._count(index)
        self._meet()

    def collisions(self, index: int) -> list[Collision]:
        """Returns the collisions of one car with anything but another car."""
        return [hit for hit in self.robots[index].collisions if hit.what not in self._named]

    def _meet(self) -> None:
        """Copies new bodies, such as a newly hitched load, into the worlds of all other cars."""
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
        """Moves the other cars in one car's world to their pose at ``now`` [s], extrapolated from their own times."""
        world = self.robots[index].world
        for other in world.others:
            owner, _ = self._named[other.name]
            touches = any(world.contacts.lasts(part, other.name) for part in ("car", "load"))
            other.follow(now - self.robots[owner].world.time, touches=touches)

    def _count(self, index: int) -> None:
        """Counts the new contacts of one car, unless the other car's world has already detected them."""
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
        raise InputError(f"robots: got {len(robots)}, wanted two or more on a shared field")
    first = robots[0]
    for robot in robots:
        if robot.tick or robot.world.others:
            raise InputError("robots: got one that already drove or shares a field, wanted new ones")
        if robot.people:
            raise InputError(f"people: got {len(robot.people)} in one car's world, wanted none on a shared field")
        if robot.period != first.period:
            raise InputError(f"period: got {first.period} and {robot.period} s, wanted the same for all robots")
        scene, other = robot.scene, first.scene
        if (scene.field, scene.obstacles, scene.polygons) != (other.field, other.obstacles, other.polygons):
            raise InputError("scenes: got different ones, wanted the same field and obstacles for all robots")
