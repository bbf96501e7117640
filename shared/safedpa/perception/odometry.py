"""Where the robot was at a moment: its last states, and straight lines between them."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from math import hypot, pi, remainder
from typing import final

__all__ = ["OdometryBuffer", "Pose"]

Pose = tuple[float, float, float]
"""x, y in m, yaw in rad, turns counted or not."""

_RETAINED = 200
"""Poses; 10 s at 20 Hz."""


@final
class OdometryBuffer:
    """Poses by the robot's own clock, the newest last."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=_RETAINED)
        self._poses: deque[Pose] = deque(maxlen=_RETAINED)

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
        passed = times[later] - times[later - 1]
        share = min((time - times[later - 1]) / passed, 1.0) if passed > 0.0 else 1.0  # a clock may be stationary
        x, y = (one + share * (other - one) for one, other in zip(before[:2], after[:2], strict=True))
        turned = remainder(after[2] - before[2], 2.0 * pi)  # the short way round: a robot may tell -pi after pi
        return x, y, before[2] + share * turned
