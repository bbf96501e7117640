"""A body of another car's world, as it stands in this car's: seen, driven into, and moved by no one here."""

from __future__ import annotations

from typing import final

import pymunk

__all__ = ["OtherBody"]


@final
class OtherBody:
    """Has the outline of ``original``, a shape of another space, and follows its body.

    It is kinematic: it has a velocity for those who touch it, and gives way to no one. What a contact does to the
    other car is worked out in that one's own world.
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
        """Goes to where the original is, and on with its velocity for so long [s], back where below 0:

        p + seconds v, yaw + seconds w. Where it ``touches``, it has no velocity of its own: else it would shove the
        car, which nothing moves back.
        """
        leads, body = self._leads, self.body
        velocity, rate = leads.velocity, leads.angular_velocity
        body.position = leads.position + velocity * seconds
        body.angle = leads.angle + rate * seconds
        body.velocity, body.angular_velocity = ((0.0, 0.0), 0.0) if touches else (velocity, rate)

    @property
    def corners(self) -> tuple[tuple[float, float], ...]:
        """m in the frame of the field, anticlockwise."""
        return tuple((at.x, at.y) for at in map(self.body.local_to_world, self.shape.get_vertices()))

    @property
    def speed(self) -> float:
        """m/s of the original's centre of mass."""
        return float(self._leads.velocity.length)
