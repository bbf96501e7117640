"""What is towed folds up when it is pushed: the room around the hitch that it needs, by how far it was driven back.

Seen from the hitch, a load that is pulled is drawn into line, one that is pushed is turned away from it. How far it is
turned is not measured; how far the robot was driven backwards is, and it bounds where the load can be.
"""

from __future__ import annotations

from math import cos, sin
from typing import Final, final

from safedpa.safety.braking import Braking

__all__ = ["TowedReach"]

_NOTHING: Final = (0.0, 0.0, 0.0)


@final
class TowedReach:
    """By how much the radius around the rear end, where the hitch is, exceeds the footprint's.

    Let w be the way driven backwards, net of what was driven forwards since, at the pose p0, e0 = (cos yaw0, sin yaw0).
    At a state near it, and at the end of the stop from there if the robot is reversing (D <= 0, as in ``Braking``),

        w' = max(0, w - e0'(p - p0)) + max(0, -D(speed)),
        growth = most clip((w' - begin) / (end - begin), 0, 1).

    Braking straight while reversing moves w - e0'p up by no more than -D comes down, so that growth does not rise under
    the brake. ``begin`` < ``end`` [m]: w at which a load may begin to leave the footprint, and at which it may stand at
    any angle; ``most`` [m] is what it then needs beyond the footprint's radius. All were measured: docs/robot.md.
    """

    def __init__(
        self,
        begin: float,
        end: float,
        most: float,
        way: float,
        pose: tuple[float, float, float],
        braking: Braking,
    ) -> None:
        self.begin, self.end, self.most = begin, end, most
        self.way = way
        self.pose = pose
        self._x, self._y, yaw = pose
        self._cosine, self._sine = cos(yaw), sin(yaw)
        self._braking = braking
        self.rate: float = most / (end - begin)
        """d(growth)/d(w) within its range; 1."""

    def growth(self, x: float, y: float, speed: float) -> float:
        """m at position (``x``, ``y``) [m] with ``speed`` [m/s]; 0 to ``most``."""
        share = (self._after(x, y, speed) - self.begin) * self.rate
        return 0.0 if share < 0.0 else self.most if share > self.most else share

    def slopes(self, x: float, y: float, speed: float) -> tuple[float, float, float]:
        """d(growth)/d(x), d(growth)/d(y), d(growth)/d(speed); 0 where the growth is at an end of its range."""
        after = self._after(x, y, speed)
        if not self.begin <= after < self.end:
            return _NOTHING
        change: float = self.rate if speed < 0.0 else 0.0
        pushed = -self.rate if self._moved(x, y) < self.way else 0.0
        return pushed * self._cosine, pushed * self._sine, -change * self._braking.slope(speed)

    def _moved(self, x: float, y: float) -> float:
        return self._cosine * (x - self._x) + self._sine * (y - self._y)

    def _after(self, x: float, y: float, speed: float) -> float:
        way = self.way - self._moved(x, y)
        way = max(way, 0.0)
        return way if speed >= 0.0 else way - self._braking.distance(speed)
