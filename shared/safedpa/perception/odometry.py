"""Pose of the robot at a past time, interpolated linearly between its last states."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from math import hypot, isfinite, pi, remainder
from typing import final

from safedpa.bus.messages.messages import StateMessage
from safedpa.errors import MessageError

__all__ = ["OdometryBuffer", "Pose", "pose_of", "speed_of"]

Pose = tuple[float, float, float]
"""x, y [m] and yaw [rad], wrapped or unwrapped."""

_BUFFER_SIZE = 200
"""Number of poses: 10 s at 20 Hz."""


def pose_of(state: StateMessage) -> Pose:
    """Returns the pose of a state: its ``pose``, or its first three values. Raises MessageError without either."""
    if state.pose and not (len(state.pose) == 3 and all(map(isfinite, state.pose))):
        raise MessageError(f"state: got a pose {state.pose}, wanted x, y, yaw, finite, or none")
    if not state.pose and len(state.values) < 3:
        raise MessageError(f"state: got {len(state.values)} values, wanted x, y, yaw first, or a pose")
    x, y, yaw = state.pose or state.values[:3]
    return x, y, yaw


def speed_of(state: StateMessage) -> float | None:
    """Returns the fourth value of a state, the speed [m/s]; None if it is not known to be one."""
    return state.values[3] if len(state.values) > 3 and not state.pose else None


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
