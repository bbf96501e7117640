"""The space that a towed load may take around the hitch, depending on the distance driven backwards."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin
from typing import final


@final
@dataclass(frozen=True)
class TrailerEnvelope:
    """The parameters of the equations of ``hitch_of``; all lengths [m].

    After driving backwards by ``begin`` a load may start to leave the footprint, after ``end`` > ``begin`` it may be at
    any angle and then needs ``most`` beyond the footprint's radius. ``way`` is the distance driven backwards at
    ``pose`` (x, y, yaw). docs/robot.md has measurements.
    """

    begin: float
    end: float
    most: float
    way: float
    pose: tuple[float, float, float]

    @property
    def numbers(self) -> tuple[float, ...]:
        """begin, growth per distance, most, way, x, y, cos yaw, sin yaw."""
        x, y, yaw = self.pose
        rate = self.most / (self.end - self.begin)
        return self.begin, rate, self.most, self.way, x, y, cos(yaw), sin(yaw)
