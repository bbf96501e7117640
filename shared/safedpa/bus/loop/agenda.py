"""When the loop of a service looks at which robot: at those alone whose moment came, and many of them in batches.

Batches under load are made as network cards make them: with many robots a loop looks a few hundred times a second.
A message that wakes a process for itself costs several times what it costs among others: two changes of thread, cold
caches, a packet of its own for the answer. With one robot nothing waits; with many, each of the loops between sense and
act adds at most one quantum to a latency that may take 0.9 of the period.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from math import inf
from typing import final

__all__ = ["LONGEST_HOLD_SECONDS", "Agenda", "quantum_for"]


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


_MANY, _FEW = 8, 4
"""Robots from which batches are made, and below which they are not made any more."""
_SHARE = 0.03
"""Of the shortest period: 1.5 ms at 20 Hz. Four loops wait one after the other, each for what came meanwhile as well:
0.08 cost fifty robots three times the latency and saved no processor. On a crowded machine more would save some."""
_SHORTEST_SECONDS = 0.001
"""Below, sleeping costs more than it saves."""
LONGEST_HOLD_SECONDS = 0.005
"""An output waits no longer than this for those of other robots."""


def quantum_for(periods: Sequence[float], *, coalescing: bool) -> float:
    """s from one batch to the next, for robots with such periods [s], 0 for one in lockstep; 0: no batches.

    A robot in lockstep stands while it waits, so nobody waits then. ``coalescing``: whether batches are made now.
    """
    if len(periods) < (_FEW if coalescing else _MANY):
        return 0.0
    quantum = _SHARE * min(periods)
    return quantum if quantum >= _SHORTEST_SECONDS else 0.0
