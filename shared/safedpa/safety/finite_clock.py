"""A clock that may fail: its readings are for people, and no decision depends on them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

__all__ = ["FiniteClock"]

_MOST = 1e15
"""s; beyond it a reading is none: the difference of two of them in microseconds has to be finite."""


@final
class FiniteClock:
    """The readings of another clock [s]; 0 where it raises, or tells no number that can be a time."""

    def __init__(self, clock: Callable[[], Any]) -> None:
        self._clock = clock

    def __call__(self) -> float:
        """The reading [s]."""
        try:
            now = float(self._clock())
        except Exception:  # noqa: BLE001 - whatever a user's clock raises, the robot must get its action
            return 0.0
        return now if -_MOST <= now <= _MOST else 0.0
