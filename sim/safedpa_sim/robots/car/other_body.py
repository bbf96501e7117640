"""A copy of another car's body in this car's world: visible and solid, but not moved by contacts here."""

from __future__ import annotations

from typing import final

import pymunk


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
