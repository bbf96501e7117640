"""One time line for all robots, though each counts from its own start."""

from __future__ import annotations

__all__ = ["TimeLine"]

_LARGEST_TIME = 1e9
"""s; about thirty years."""


class TimeLine:
    """t = robot time + offset of the robot's epoch.

    The first robot's offset is 0: its t is its robot time. A robot that appears later, or starts anew, begins at the t
    of now, so that the view of the last seconds shows every robot and no second life covers the first.
    """

    def __init__(self) -> None:
        self._offsets: dict[tuple[str, int], float] = {}
        self._newest: tuple[float, float] | None = None

    def now(self, clock: float) -> float:
        """t at ``clock`` [s], the dashboard's monotonic clock; 0 before the first robot."""
        return 0.0 if self._newest is None else self._newest[0] + (clock - self._newest[1])

    def at(self, robot: str, epoch: int, robot_time: float, clock: float) -> float:
        """t of a message that arrived at ``clock``."""
        robot_time = max(-_LARGEST_TIME, min(robot_time, _LARGEST_TIME))
        key = (robot, epoch)
        if key not in self._offsets:
            self._offsets = {other: offset for other, offset in self._offsets.items() if other[0] != robot}
            self._offsets[key] = 0.0 if self._newest is None else self.now(clock) - robot_time
        moment = robot_time + self._offsets[key]
        if self._newest is None or moment > self._newest[0]:
            self._newest = (moment, clock)
        return moment

    def offset(self, robot: str, epoch: int) -> float:
        """t - robot time [s]; 0 for an epoch not heard of."""
        return self._offsets.get((robot, epoch), 0.0)
