"""Which robot is to be looked at when: the loop of a service then looks at those alone, however many there are."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from math import inf
from typing import final

__all__ = ["Agenda"]


@final
class Agenda:
    """Moments [s] by robot. A moment that is not needed any more is not taken back: looking once too often is cheap.

    Robots that are served together have their moments together, so each moment stands there once.
    """

    def __init__(self) -> None:
        self._moments: list[float] = []
        self._robots: dict[float, list[str]] = {}
        """By moment."""

    def at(self, when: float, robot: str) -> None:
        """Adds a moment; never, where it is infinite."""
        robots = self._robots.get(when)
        if robots is not None:
            robots.append(robot)
        elif when < inf:
            self._robots[when] = [robot]
            heapq.heappush(self._moments, when)

    def due(self, now: float) -> list[str]:
        """Takes the robots whose moment has come, earliest first; each once."""
        moments = self._moments
        if not moments or moments[0] > now:
            return []
        found: dict[str, None] = {}
        while moments and moments[0] <= now:
            found.update(dict.fromkeys(self._robots.pop(heapq.heappop(moments))))
        return list(found)

    def next(self, awaited: Callable[[str], bool] | None = None) -> float:
        """The earliest moment; infinite where there is none.

        A moment at whose coming no robot is ``awaited`` any more is taken back: nobody has to wake up for it.
        """
        moments = self._moments
        while awaited is not None and moments and not any(map(awaited, self._robots[moments[0]])):
            del self._robots[heapq.heappop(moments)]
        return moments[0] if moments else inf

    def __len__(self) -> int:
        return sum(map(len, self._robots.values()))
