"""Outlines of bodies seen from above, in metres and radians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from safedpa_services.dashboard.shapes import Point

__all__ = ["FARTHEST", "BodyPose", "capsule", "drawable", "rectangle"]

FARTHEST = 1e5
"""Largest drawn coordinate [m]: the viewer computes with 32-bit floats."""

_ARC_POINTS = 12


@dataclass(frozen=True, slots=True)
class BodyPose:
    """Position [m] and yaw [rad] of a body."""

    x: float
    y: float
    yaw: float

    def place(self, points: Sequence[Point]) -> tuple[Point, ...]:
        """Transforms points from the body's frame (ahead, left) to the world."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return tuple((self.x + c * ahead - s * left, self.y + s * ahead + c * left) for ahead, left in points)


def drawable(*numbers: float) -> bool:
    """Returns whether all numbers are finite and small enough to be drawn."""
    return all(math.isfinite(number) and abs(number) <= FARTHEST for number in numbers)


def rectangle(rear: float, front: float, width: float) -> tuple[Point, ...]:
    """Returns the closed outline of a rectangle from ``rear`` to ``front`` [m] ahead of the origin."""
    half = 0.5 * width
    return ((rear, -half), (front, -half), (front, half), (rear, half), (rear, -half))


def capsule(rear: float, front: float, radius: float) -> tuple[Point, ...]:
    """Returns the closed outline of a capsule from ``rear`` to ``front`` ahead of the origin, with ``radius`` [m]."""
    angles = [math.pi * (step / _ARC_POINTS - 0.5) for step in range(_ARC_POINTS + 1)]
    nose = [(front + radius * math.cos(angle), radius * math.sin(angle)) for angle in angles]
    tail = [(rear - radius * math.cos(angle), -radius * math.sin(angle)) for angle in angles]
    return (*nose, *tail, nose[0])
