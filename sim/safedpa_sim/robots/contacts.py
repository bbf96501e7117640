"""Counting collisions: pymunk says when two shapes begin and end to touch."""

from __future__ import annotations

from dataclasses import dataclass

import pymunk

__all__ = ["CAR", "LOAD", "OBSTACLE", "WALL", "Collision", "ContactCounter"]

CAR, LOAD, OBSTACLE, WALL = 1, 2, 3, 4
"""pymunk's collision types."""

_SAME_CONTACT_SECONDS = 0.2
"""A contact that breaks off for less than this is still the same one: bodies rattle before they rest."""


@dataclass(frozen=True)
class Collision:
    """One contact of body or load with something solid."""

    time: float
    """s since the robot's start."""
    part: str
    """``car`` or ``load``."""
    what: str
    """``obstacle 3`` or ``wall east``."""
    x: float
    y: float
    """m; where the car or load was."""
    speed: float
    """m/s; how fast its centre moved when it touched."""
    towards: float
    """m/s; n^T v: how fast the place that touched drove into the other along the normal n; below 0 away from it."""

    def __str__(self) -> str:
        how = f"{self.speed:.2f} m/s, {self.towards:.2f} m/s towards it"
        return f"{self.part} against {self.what} at t={self.time:.2f} s, {how}"


class ContactCounter:
    """Collects the collisions of car and load with obstacles and walls."""

    def __init__(self, space: pymunk.Space) -> None:
        self.collisions: list[Collision] = []
        self.time = 0.0
        """s; kept up to date by the world."""
        self._names: dict[pymunk.Shape, str] = {}
        self._touching: set[tuple[str, str]] = set()
        self._ended: dict[tuple[str, str], float] = {}
        for part in (CAR, LOAD):
            for solid in (OBSTACLE, WALL):
                space.on_collision(part, solid, begin=self._begin, separate=self._separate)

    def name(self, shape: pymunk.Shape, name: str) -> None:
        """What collisions with ``shape`` are called."""
        self._names[shape] = name

    def lasts(self, part: str, what: str) -> bool:
        """Whether ``part`` touches ``what``, or did a moment ago: what begins now is the same contact."""
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
    """m/s at which the body's place that touches drives along the normal, which points to what it touches."""
    touched = arbiter.contact_point_set
    return max(float(body.velocity_at_world_point(one.point_a).dot(touched.normal)) for one in touched.points)


def _stop(body: pymunk.Body | None) -> None:
    """Someone stops in the moment in which he touches: else a body that moves as it is told would shove the car."""
    if body is not None and body.body_type == pymunk.Body.KINEMATIC:
        body.velocity = (0.0, 0.0)
