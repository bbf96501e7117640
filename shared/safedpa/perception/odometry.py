"""Where the robot was at a moment: its last states, and straight lines between them."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from math import hypot
from typing import final

__all__ = ["Odometry", "Pose"]

Pose = tuple[float, float, float]
"""x, y in m, yaw in rad, turns counted."""

_KEPT = 200
"""Poses; 10 s at 20 Hz."""


@final
class Odometry:
    """Poses by the robot's own clock, the newest last."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=_KEPT)
        self._poses: deque[Pose] = deque(maxlen=_KEPT)

    def add(self, time: float, pose: Pose) -> None:
        """The pose at ``time`` [s], later than all before."""
        self._times.append(time)
        self._poses.append(pose)

    @property
    def last_step(self) -> float:
        """m from the last pose but one to the last."""
        if len(self._poses) < 2:
            return 0.0
        (x, y, _), (before_x, before_y, _) = self._poses[-1], self._poses[-2]
        return hypot(x - before_x, y - before_y)

    def at(self, time: float) -> Pose | None:
        """The pose at ``time`` [s]; None before the first or after the last one that is known."""
        times = self._times
        if not times or not times[0] - 1e-9 <= time <= times[-1] + 1e-9:
            return None
        later = min(bisect_left(times, time), len(times) - 1)
        if later == 0:
            return self._poses[0]
        before, after = self._poses[later - 1], self._poses[later]
        share = min((time - times[later - 1]) / (times[later] - times[later - 1]), 1.0)
        x, y, yaw = (one + share * (other - one) for one, other in zip(before, after, strict=True))
        return x, y, yaw
