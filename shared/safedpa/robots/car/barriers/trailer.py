"""What is towed folds up when it is pushed: the room around the hitch that it needs, by how far it was driven back."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin
from typing import final

__all__ = ["TrailerEnvelope"]


@final
@dataclass(frozen=True)
class TrailerEnvelope:
    """What the equations of ``hitch_of`` need; all lengths [m].

    ``begin`` < ``end``: the way w driven backwards at which a load may begin to leave the footprint, and at which it
    may stand at any angle; ``most`` is what it then needs beyond the footprint's radius; ``way`` is w at ``pose``
    (x, y, yaw). The lengths were measured: docs/robot.md.
    """

    begin: float
    end: float
    most: float
    way: float
    pose: tuple[float, float, float]

    @property
    def numbers(self) -> tuple[float, ...]:
        """begin, growth over w, most, w, x, y, cos yaw, sin yaw."""
        x, y, yaw = self.pose
        rate = self.most / (self.end - self.begin)
        return self.begin, rate, self.most, self.way, x, y, cos(yaw), sin(yaw)
