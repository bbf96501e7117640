"""How far a robot that tows was driven backwards: counted by its filter, and by itself where it tells."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin

__all__ = ["distance_reversed"]


def distance_reversed(way: float, before: Sequence[float], now: Sequence[float], most: float) -> float:
    """w+ = clip(w - e'(p+ - p), 0, most) [m] of a robot that went from one pose to another (x, y, yaw, ...).

    e is the heading and p the position ``before``; what is driven forwards is taken off again.
    """
    moved = cos(before[2]) * (now[0] - before[0]) + sin(before[2]) * (now[1] - before[1])
    return min(max(way - moved, 0.0), most)
