"""Collision counting from pymunk's callbacks at begin and end of a contact, and copies of other cars' bodies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import pymunk

CAR, LOAD, OBSTACLE, WALL = 1, 2, 3, 4
"""pymunk's collision types."""

_SAME_CONTACT_SECONDS = 0.2
"""A contact that is interrupted for less than this counts as one: bodies rattle before they come to rest."""


@dataclass(frozen=True)
class Collision:
    """One contact of car or load with a solid object."""

    time: float
    """s since the robot's start."""
    part: str
    """``car`` or ``load``."""
    what: str
    """``obstacle 3`` or ``wall east``."""
    x: float
    y: float
    """m; position of the car or load."""
    speed: float
    """m/s; speed of its centre at the contact."""
    towards: float
    """m/s; n^T v, the approach speed of the contact point along the normal n; negative when moving away."""

    def __str__(self) -> str:
        how = f"{self.speed:.2f} m/s, {self.towards:.2f} m/s towards it"
        return f"{self.part} against {self.what} at t={self.time:.2f} s, {how}"


class ContactCounter:
    """Collects the collisions of car and load with obstacles and walls."""

    def __init__(self, space: pymunk.Space) -> None:
        self.collisions: list[Collision] = []
        self.time = 0.0
        """s; updated by the world."""
        self._names: dict[pymunk.Shape, str] = {}
        self._touching: set[tuple[str, str]] = set()
        self._ended: dict[tuple[str, str], float] = {}
        for part in (CAR, LOAD):
            for solid in (OBSTACLE, WALL):
                space.on_collision(part, solid, begin=self._begin, separate=self._separate)

    def name(self, shape: pymunk.Shape, name: str) -> None:
        """Sets the name of ``shape`` in collisions."""
        self._names[shape] = name

    def lasts(self, part: str, what: str) -> bool:
        """Returns whether ``part`` touches ``what`` or did within 0.2 s, so that a new touch is not counted."""
        return self._lasts((part, what))

    def _lasts(self, pair: tuple[str, str]) -> bool:
        ended = self._ended.get(pair, -_SAME_CONTACT_SECONDS)
        return pair in self._touching or self.time - ended < _SAME_CONTACT_SECONDS

    def _pair(self, arbiter: pymunk.Arbiter) -> tuple[str, str]:
        part, solid = arbiter.shapes
        return self._names[part], self._names[solid]

    def _begin(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: object) -> None:
        del space, data
        pair = self._pair(arbiter)
        if not self._lasts(pair):
            body = arbiter.shapes[0].body
            assert body is not None
            x, y = body.position
            speeds = body.velocity.length, _towards(arbiter, body)
            self.collisions.append(Collision(round(self.time, 6), *pair, x, y, *speeds))
        self._touching.add(pair)
        _stop(arbiter.shapes[1].body)

    def _separate(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: object) -> None:
        del space, data
        pair = self._pair(arbiter)
        self._touching.discard(pair)
        self._ended[pair] = self.time


def _towards(arbiter: pymunk.Arbiter, body: pymunk.Body) -> float:
    """Returns the speed [m/s] of the body's contact point along the normal, which points to the touched object."""
    touched = arbiter.contact_point_set
    return max(float(body.velocity_at_world_point(one.point_a).dot(touched.normal)) for one in touched.points)


def _stop(body: pymunk.Body | None) -> None:
    """Stops a kinematic body when it touches the car; otherwise it would push the car with unlimited force."""
    if body is not None and body.body_type == pymunk.Body.KINEMATIC:
        body.velocity = (0.0, 0.0)


@final
class OtherBody:
    """A kinematic body with the outline of ``original``, a shape of another space, that follows the original's body.

    It has a velocity, but contacts do not move it. The effect of a contact on the other car is computed in that car's
    own world.
    """

    def __init__(self, space: pymunk.Space, original: pymunk.Poly, kind: int, name: str) -> None:
        assert original.body is not None
        self.name, self._leads = name, original.body
        self.body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.shape = pymunk.Poly(self.body, original.get_vertices())
        self.shape.friction, self.shape.collision_type = original.friction, kind
        self.follow(0.0, touches=False)
        space.add(self.body, self.shape)

    def follow(self, seconds: float, *, touches: bool) -> None:
        """Moves to the original's pose, extrapolated by ``seconds`` (may be negative): p + seconds v, yaw + seconds w.

        While it ``touches`` the car, its velocity is 0; otherwise it would push the car without any reaction.
        """
        leads, body = self._leads, self.body
        velocity, rate = leads.velocity, leads.angular_velocity
        body.position = leads.position + velocity * seconds
        body.angle = leads.angle + rate * seconds
        body.velocity, body.angular_velocity = ((0.0, 0.0), 0.0) if touches else (velocity, rate)

    @property
    def corners(self) -> tuple[tuple[float, float], ...]:
        """Corners [m] in the frame of the field, anticlockwise."""
        return tuple((at.x, at.y) for at in map(self.body.local_to_world, self.shape.get_vertices()))

    @property
    def speed(self) -> float:
        """Speed of the original's centre of mass [m/s]."""
        return float(self._leads.velocity.length)
