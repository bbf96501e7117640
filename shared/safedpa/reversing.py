"""Net distance that a towing robot has driven in reverse; used by the filter and by the robot itself."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin

__all__ = ["distance_reversed"]


def distance_reversed(distance: float, before: Sequence[float], now: Sequence[float], most: float) -> float:
    """Returns clip(d - e'(p+ - p), 0, most) [m] after a motion from one pose to another (x, y, yaw, ...).

    d is the distance so far, e the heading and p the position ``before``. Forward motion reduces the distance.
    """
    moved = cos(before[2]) * (now[0] - before[0]) + sin(before[2]) * (now[1] - before[1])
    return min(max(distance - moved, 0.0), most)
