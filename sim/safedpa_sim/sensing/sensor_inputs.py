"""What a simulated car senses with, and whom it meets: laser scanners and people, in its world."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, final

from safedpa.bus.messages.messages import ScanMessage
from safedpa_sim.sensing.laser import Laser
from safedpa_sim.sensing.people import Person
from safedpa_sim.sensing.shapes import Outline, Point, Polygon, box

if TYPE_CHECKING:
    import pymunk

    from safedpa_sim.robots.scene import Scene
    from safedpa_sim.robots.world import CarWorld

__all__ = ["SimulatedSensors"]

_TOUCHES = 0.01
"""m"""
_STEP = 0.05
"""s; people choose their way so often, and walk straight in between."""


@final
class SimulatedSensors:
    """Laser scanners and people of one car. ``glass`` names the polygons of the scene that let rays through."""

    def __init__(
        self,
        lasers: Sequence[Laser],
        people: Sequence[Person] = (),
        glass: Sequence[int] = (),
        *,
        sees_load: bool = True,
    ) -> None:
        self.lasers, self.people = tuple(lasers), tuple(people)
        self.names = tuple(laser.settings.name for laser in self.lasers)
        """Of the sensors."""
        self._glass, self._sees_load = frozenset(glass), sees_load
        self._bodies: list[pymunk.Body] = []
        self._steps = 0

    def join(self, world: CarWorld, scene: Scene, epoch: int) -> None:
        """Puts the people into the world; once, before anything else."""
        self._world, self._epoch = world, epoch
        self._solid = Outline(scene.obstacles, scene.polygons, (scene.field,))
        seen = tuple(one for index, one in enumerate(scene.polygons) if index not in self._glass)
        self._seen = Outline(scene.obstacles, seen, (scene.field,))
        self._bodies = [
            world.add_person(*person.place, person.radius, f"person {index}")
            for index, person in enumerate(self.people)
        ]

    def moments(self, end: float) -> Iterator[float]:
        """s; in order, up to and with ``end``, when someone chooses a way or a scanner measures."""
        while (moment := min([self._steps * _STEP, *(laser.next_scan for laser in self.lasers)])) <= end + 1e-9:
            yield moment

    def sense(self, tick: int) -> None:
        """Does what is due at the world's time."""
        now = self._world.time + 1e-9
        for person, body in zip(self.people, self._bodies, strict=True):
            person.place = (body.position.x, body.position.y)
        if self._steps * _STEP <= now:
            self._steps += 1
            x, y, _, _ = self._world.state
            for person, body in zip(self.people, self._bodies, strict=True):
                away, outwards = self._to_robot(person)
                if away < _TOUCHES:
                    person.touched(self._world.time)
                wanted = person.velocity(self._world.time, (x, y), self._solid)
                body.velocity = wanted if away > 0.0 else _along(wanted, outwards)
        for laser in self.lasers:
            if laser.next_scan <= now:
                laser.scan(self._world.state[:3], self._outline(), self._epoch, tick)

    def _to_robot(self, person: Person) -> tuple[float, Point]:
        """m from someone to the car's body or what it tows, 0 or less where they touch; and the way from it to him."""
        towed = self._world.towed
        shapes = [*self._world.body.shapes, *([] if towed is None else [towed.shape])]
        nearest = min((shape.point_query(person.place) for shape in shapes), key=lambda found: found.distance)
        return nearest.distance - person.radius, (nearest.gradient.x, nearest.gradient.y)

    def reported(self) -> list[ScanMessage]:
        """The scans that are due by now."""
        return [message for laser in self.lasers for message in laser.reported(self._world.time)]

    def _outline(self) -> Outline:
        """What can be seen now: things at rest, people, other cars, and the load that is towed."""
        people = tuple((*person.place, person.radius) for person in self.people)
        towed = self._world.towed if self._sees_load else None
        moving: tuple[Polygon, ...] = tuple(other.corners for other in self._world.others)
        if towed is not None:
            x, y, yaw, length, width = towed.pose
            moving += (box(x, y, length, width, yaw),)
        return Outline(self._seen.circles + people, self._seen.polygons + moving, self._seen.rooms)


def _along(velocity: Point, outwards: Point) -> Point:
    """What is left of a velocity [m/s] of who touches something: nothing of it leads into it."""
    inwards = min(velocity[0] * outwards[0] + velocity[1] * outwards[1], 0.0)
    return velocity[0] - inwards * outwards[0], velocity[1] - inwards * outwards[1]
