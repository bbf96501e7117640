"""Pose of the robot at a past time, interpolated linearly between its last states."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from math import hypot, pi, remainder
from typing import final

__all__ = ["OdometryBuffer", "Pose"]

Pose = tuple[float, float, float]
"""x, y [m] and yaw [rad], wrapped or unwrapped."""

_BUFFER_SIZE = 200
"""Number of poses: 10 s at 20 Hz."""


@final
class OdometryBuffer:
    """Buffer of poses by the robot's clock, newest last."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=_BUFFER_SIZE)
        self._poses: deque[Pose] = deque(maxlen=_BUFFER_SIZE)

    def add(self, time: float, pose: Pose) -> None:
        """Adds the pose at ``time`` [s], which must be later than all others."""
        self._times.append(time)
        self._poses.append(pose)

    @property
    def last_step(self) -> float:
        """Distance between the last two poses, m."""
        if len(self._poses) < 2:
            return 0.0
        (x, y, _), (before_x, before_y, _) = self._poses[-1], self._poses[-2]
        return hypot(x - before_x, y - before_y)

    def at(self, time: float) -> Pose | None:
        """Returns the pose at ``time`` [s]; None before the first or after the last pose."""
        times = self._times
        if not times or not times[0] - 1e-9 <= time <= times[-1] + 1e-9:
            return None
        later = min(bisect_left(times, time), len(times) - 1)
        if later == 0:
            return self._poses[0]
        before, after = self._poses[later - 1], self._poses[later]
        passed = times[later] - times[later - 1]
        share = min((time - times[later - 1]) / passed, 1.0) if passed > 0.0 else 1.0  # times may be equal
        x, y = (one + share * (other - one) for one, other in zip(before[:2], after[:2], strict=True))
        turned = remainder(after[2] - before[2], 2.0 * pi)  # shortest rotation: yaw may wrap from pi to -pi
        return x, y, before[2] + share * turned
