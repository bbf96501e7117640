"""The laser scanners and people in the world of one simulated car."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, final

from safedpa.bus.messages.messages import ScanMessage
from safedpa_sim.sensing.laser import Laser
from safedpa_sim.sensing.other_sources import OtherSource
from safedpa_sim.sensing.people import Person
from safedpa_sim.sensing.shapes import Outline, Point, Polygon, box

if TYPE_CHECKING:
    import pymunk

    from safedpa_sim.robots.car.scene import Scene
    from safedpa_sim.robots.car.world import CarWorld

_TOUCHES = 0.01
"""m"""
_STEP = 0.05
"""s; interval at which people choose their velocity."""


@final
class SimulatedSensors:
    """The sensors and people of one car. ``glass`` holds the indices of polygons that rays pass through."""

    def __init__(
        self,
        lasers: Sequence[Laser | OtherSource],
        people: Sequence[Person] = (),
        glass: Sequence[int] = (),
        *,
        sees_load: bool = True,
    ) -> None:
        self.lasers, self.people = tuple(lasers), tuple(people)
        self.names = tuple(laser.settings.name for laser in self.lasers)
        """Names of the sensors."""
        self._glass, self._sees_load = frozenset(glass), sees_load
        self._bodies: list[pymunk.Body] = []
        self._steps = 0

    def join(self, world: CarWorld, scene: Scene, epoch: int) -> None:
        """Adds the people to the world; call once, before any other method."""
        self._world, self._epoch = world, epoch
        self._solid = Outline(scene.obstacles, scene.polygons, (scene.field,))
        seen = tuple(one for index, one in enumerate(scene.polygons) if index not in self._glass)
        self._seen = Outline(scene.obstacles, seen, (scene.field,))
        self._bodies = [
            world.add_person(*person.position, person.radius, f"person {index}")
            for index, person in enumerate(self.people)
        ]

    def moments(self, end: float) -> Iterator[float]:
        """Yields the times [s] up to ``end`` at which people choose their velocity or a scanner measures, in order."""
        while (moment := min([self._steps * _STEP, *(laser.next_scan for laser in self.lasers)])) <= end + 1e-9:
            yield moment

    def sense(self, tick: int) -> None:
        """Updates people and takes measurements that are due at the world's time."""
        now = self._world.time + 1e-9
        for person, body in zip(self.people, self._bodies, strict=True):
            person.position = (body.position.x, body.position.y)
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
        """Returns the gap [m] between a person and car or load (<= 0 when touching) and the direction to the person."""
        towed = self._world.towed
        shapes = [*self._world.body.shapes, *([] if towed is None else [towed.shape])]
        nearest = min((shape.point_query(person.position) for shape in shapes), key=lambda found: found.distance)
        return nearest.distance - person.radius, (nearest.gradient.x, nearest.gradient.y)

    def reported(self) -> list[ScanMessage]:
        """Returns the scans that are due now."""
        return [message for laser in self.lasers for message in laser.reported(self._world.time)]

    def _outline(self) -> Outline:
        """Returns everything visible now: stationary obstacles, people, other cars and the load."""
        people = tuple((*person.position, person.radius) for person in self.people)
        towed = self._world.towed if self._sees_load else None
        moving: tuple[Polygon, ...] = tuple(other.corners for other in self._world.others)
        if towed is not None:
            x, y, yaw, length, width = towed.pose
            moving += (box(x, y, length, width, yaw),)
        return Outline(self._seen.circles + people, self._seen.polygons + moving, self._seen.rooms)


def _along(velocity: Point, outwards: Point) -> Point:
    """Removes the component of a velocity [m/s] that points into the touched object."""
    inwards = min(velocity[0] * outwards[0] + velocity[1] * outwards[1], 0.0)
    return velocity[0] - inwards * outwards[0], velocity[1] - inwards * outwards[1]
