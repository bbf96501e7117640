"""Batches under load, as network cards make them: with many robots a loop looks a few hundred times a second.

A message that wakes a process for itself costs several times what it costs among others: two changes of thread, cold
caches, a packet of its own for the answer. With one robot nothing waits; with many, each of the loops between sense and
act adds at most one quantum to a latency that may take 0.9 of the period.
"""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["LONGEST_HOLD_SECONDS", "quantum_for"]

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
