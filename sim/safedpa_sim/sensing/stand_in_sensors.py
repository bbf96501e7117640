"""The laser scanners and people around a stand-in, which knows neither."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, sin
from typing import final

from safedpa.bus.messages.messages import ScanMessage
from safedpa.safety.barriers.planar_body import BodyPart
from safedpa.stand_in import AbstractStandIn
from safedpa_sim.sensing.laser import Laser
from safedpa_sim.sensing.other_sources import OtherSource
from safedpa_sim.sensing.people import Person
from safedpa_sim.sensing.shapes import Outline, Point, Polygon

_STEP = 0.05
"""s; interval at which people choose their velocity."""
_TOUCHES = 0.01
"""m"""


@final
class StandInSensors:
    """Scanners on a stand-in among its obstacles and walls, ``polygons`` and people; lengths in m.

    ``pose`` holds the places of x, y and yaw in the stand-in's state; a yaw of -1 means that it does not turn.
    ``parts`` are its body, by default the capsule of its footprint.
    """

    def __init__(
        self,
        lasers: Sequence[Laser | OtherSource],
        people: Sequence[Person] = (),
        polygons: Sequence[Polygon] = (),
        pose: tuple[int, int, int] = (0, 1, 2),
        parts: Sequence[BodyPart] = (),
    ) -> None:
        self._parts = tuple(parts)
        self.lasers, self.people, self._polygons, self._pose = tuple(lasers), tuple(people), tuple(polygons), pose
        self.names = tuple(laser.settings.name for laser in self.lasers)
        """Names of the sensors."""
        self._time, self._chosen = 0.0, 0
        self._velocities: list[Point] = [(0.0, 0.0)] * len(self.people)

    def solid(self, stand_in: AbstractStandIn) -> Outline:
        """Returns what does not move."""
        rooms = (tuple(stand_in.field),) if len(stand_in.field) == 4 else ()
        circles = tuple((x, y, radius) for x, y, radius in stand_in.obstacles)
        return Outline(circles, self._polygons, rooms)  # type: ignore[arg-type]

    def begin(self, stand_in: AbstractStandIn, epoch: int) -> None:
        """Takes the measurements that are due before the first state."""
        self._sense(stand_in, epoch, 0)

    def advance(
        self, stand_in: AbstractStandIn, action: tuple[float, ...], period: float, epoch: int, tick: int
    ) -> str:
        """Simulates a period of robot and people; returns who the robot touched, empty if no one."""
        end, touched = self._time + period, ""
        while self._time < end - 1e-9:
            following = min([end, (self._chosen + 1) * _STEP, *(laser.next_scan for laser in self.lasers)])
            seconds = max(following - self._time, 1e-6)
            stand_in.advance(action, seconds)
            self._time += seconds
            for index, person in enumerate(self.people):
                vx, vy = self._velocities[index]
                person.position = (person.position[0] + vx * seconds, person.position[1] + vy * seconds)
                if self._gap(stand_in, person)[0] < _TOUCHES:
                    person.touched(self._time)
                    touched = touched or f"person {index}"
            self._sense(stand_in, epoch, tick)
        return touched

    def reported(self) -> list[ScanMessage]:
        """Returns the scans that are due now."""
        return [message for laser in self.lasers for message in laser.reported(self._time)]

    def outline(self, stand_in: AbstractStandIn) -> Outline:
        """Returns everything that rays hit now."""
        solid = self.solid(stand_in)
        people = tuple((*person.position, person.radius) for person in self.people)
        return Outline(solid.circles + people, solid.polygons, solid.rooms)

    def pose(self, stand_in: AbstractStandIn) -> tuple[float, float, float]:
        """Returns x, y [m] and yaw [rad] of the stand-in."""
        x, y, yaw = self._pose
        values = stand_in.values
        return values[x], values[y], values[yaw] if yaw >= 0 else 0.0

    def reported_pose(self, stand_in: AbstractStandIn) -> tuple[float, ...]:
        """Returns the pose for the state message; empty if the state begins with it."""
        return () if self._pose == (0, 1, 2) else self.pose(stand_in)

    def _sense(self, stand_in: AbstractStandIn, epoch: int, tick: int) -> None:
        now = self._time + 1e-9
        if self._chosen * _STEP <= now and self.people:
            self._chosen = round(self._time / _STEP) + 1
            x, y, _ = self.pose(stand_in)
            solid = self.solid(stand_in)
            self._velocities = [
                self._slid(stand_in, one, one.velocity(self._time, (x, y), solid)) for one in self.people
            ]
        elif not self.people:
            self._chosen = round(self._time / _STEP) + 1
        for laser in self.lasers:
            while laser.next_scan <= now:
                laser.scan(self.pose(stand_in), self.outline(stand_in), epoch, tick)

    def _slid(self, stand_in: AbstractStandIn, person: Person, wanted: Point) -> Point:
        """Removes the component of a person's velocity [m/s] that points into a robot which it touches."""
        gap, (out_x, out_y) = self._gap(stand_in, person)
        inwards = min(wanted[0] * out_x + wanted[1] * out_y, 0.0) if gap < _TOUCHES else 0.0
        return wanted[0] - inwards * out_x, wanted[1] - inwards * out_y

    def _gap(self, stand_in: AbstractStandIn, person: Person) -> tuple[float, Point]:
        """Returns the gap [m] between a person and the footprint, and the direction to the person."""
        x, y, _ = self.pose(stand_in)
        out_x, out_y = person.position[0] - x, person.position[1] - y
        away = max(hypot(out_x, out_y), 1e-9)
        return self.gap_to(stand_in, *person.position) - person.radius, (out_x / away, out_y / away)

    def gap_to(self, stand_in: AbstractStandIn, at_x: float, at_y: float) -> float:
        """Returns the distance [m] of a position from the body; negative inside."""
        x, y, yaw = self.pose(stand_in)
        apart_x, apart_y = at_x - x, at_y - y
        place = apart_x * cos(yaw) + apart_y * sin(yaw), apart_y * cos(yaw) - apart_x * sin(yaw)
        parts = self._parts
        if not parts:
            rear, front, radius = stand_in.footprint if len(stand_in.footprint) == 3 else (0.0, 0.0, 0.0)
            parts = (BodyPart(((-rear, 0.0), (front, 0.0)), radius),)
        return min(part.distance(*place) for part in parts)
