"""Which robot is to be looked at when: the loop of a service then looks at those alone, however many there are."""

from __future__ import annotations

import heapq
from typing import final

__all__ = ["Agenda"]


@final
class Agenda:
    """Moments [s] by robot. A moment that is not needed any more is not taken back: looking once too often is cheap."""

    def __init__(self) -> None:
        self._moments: list[tuple[float, str]] = []

    def at(self, when: float, robot: str) -> None:
        """Adds a moment; never, where it is infinite."""
        if when < float("inf"):
            heapq.heappush(self._moments, (when, robot))

    def due(self, now: float) -> list[str]:
        """Takes the robots whose moment has come, earliest first; each once."""
        found: dict[str, None] = {}
        while self._moments and self._moments[0][0] <= now:
            found[heapq.heappop(self._moments)[1]] = None
        return list(found)

    def next(self) -> float:
        """The earliest moment; infinite where there is none."""
        return self._moments[0][0] if self._moments else float("inf")

    def __len__(self) -> int:
        return len(self._moments)
