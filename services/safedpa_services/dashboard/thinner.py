"""How much of what arrives is drawn: at most 20 times a second of robot time, and less when drawing falls behind."""

from __future__ import annotations

__all__ = ["Pace", "Thinner"]

SHORTEST_INTERVAL = 0.05
"""s of robot time between two drawn messages of one kind."""

_BEHIND_SECONDS = 0.5
_CAUGHT_UP_SECONDS = 0.1
_CALM_SECONDS = 2.0
_LARGEST_FACTOR = 64


class Pace:
    """One number for the whole dashboard: every ``factor``-th picture is drawn. Doubles while behind."""

    def __init__(self) -> None:
        self.factor = 1
        self._calm_since: float | None = None

    def observe(self, lag: float, now: float) -> bool:
        """Takes how long [s] the oldest message had waited; True when the factor changed."""
        before = self.factor
        if lag > _BEHIND_SECONDS:
            self.factor = min(2 * self.factor, _LARGEST_FACTOR)
            self._calm_since = None
        elif lag > _CAUGHT_UP_SECONDS:
            self._calm_since = None
        elif self._calm_since is None:
            self._calm_since = now
        elif now - self._calm_since >= _CALM_SECONDS:
            self.factor = max(self.factor // 2, 1)
            self._calm_since = now
        return self.factor != before


class Thinner:
    """Decides for one robot, by kind of message, and counts what was left out because drawing was behind."""

    def __init__(self) -> None:
        self._last: dict[str, float] = {}
        self.left_out = 0

    def draws(self, kind: str, robot_time: float, factor: int) -> bool:
        """Whether a message stamped ``robot_time`` [s] is drawn."""
        last = self._last.get(kind)
        passed = None if last is None else robot_time - last
        if passed is None or passed < 0.0 or passed > 0.9 * factor * SHORTEST_INTERVAL:
            self._last[kind] = robot_time
            return True
        self.left_out += passed > 0.9 * SHORTEST_INTERVAL
        return False
