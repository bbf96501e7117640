"""When a loop looks at which robot, and who turns the loops of a process.

A loop looks at those robots alone whose moment came, and at many of them in batches. Batches under load are made as
network cards make them: with many robots a loop looks a few hundred times a second. A message that wakes a process for
itself costs several times what it costs among others: two changes of thread, cold caches, a packet of its own for the
answer. With one robot nothing waits; with many, each of the loops between sense and act adds at most one quantum to a
latency that may take 0.9 of the period.

Loops are turned by the thread that brings a message, or, for what no message brings, by the main thread. A message that
has to wake another thread first is on its way for 100 to 150 us longer, at each of the hops from sense to act. So the
network's thread itself turns the loop when no one else does; it never waits for the loop. With many robots, whose
messages are gathered without any thread of Python, the main thread turns alone, some hundred times a second.
"""

from __future__ import annotations

import heapq
import threading
from collections.abc import Callable, Sequence
from math import inf
from typing import TYPE_CHECKING, final

if TYPE_CHECKING:
    from safedpa.bus.service.service_loop import ServiceLoop

__all__ = ["MAX_HOLD_SECONDS", "Scheduler", "TimerQueue", "batch_interval"]

_LONGEST_WAIT_SECONDS = 0.25
_LONGEST_END_SECONDS = 5.0
"""A car brakes from full speed to a stand in 1.2 s; a container gets 10 s before it is killed."""
_END_TURN_SECONDS = 0.05


@final
class TimerQueue:
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

        A moment at whose coming no robot is ``awaited`` any more is taken back: no one has to wake up for it.
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
MAX_HOLD_SECONDS = 0.005
"""An output waits no longer than this for those of other robots."""


def batch_interval(periods: Sequence[float], *, coalescing: bool) -> float:
    """s from one batch to the next, for robots with such periods [s], 0 for one in lockstep; 0: no batches.

    A robot in lockstep stands while it waits, so no one waits then. ``coalescing``: whether batches are made now.
    """
    if len(periods) < (_FEW if coalescing else _MANY):
        return 0.0
    quantum = _SHARE * min(periods)
    return quantum if quantum >= _SHORTEST_SECONDS else 0.0


@final
class Scheduler:
    """Turns service loops of one process together, in the order given, which is that of their data."""

    def __init__(self, loops: Sequence[ServiceLoop]) -> None:
        self._loops = loops
        self._turns = threading.Lock()
        """Held by the thread that turns."""
        self._next_look = 0.0
        """s; when it is asked again whether batches are worth it."""
        self._changed = threading.Event()
        """Another thread turned: the moments at which something is due may be others now."""

    def run(self, stopped: Callable[[], bool]) -> None:
        """Turns until ``stopped``, then until nothing is left to do for any robot that still speaks, 5 s at most.

        Looks at ``stopped`` four times a second.
        """
        for loop in self._loops:
            loop.inbox.lead(self._came)
        try:
            while not stopped():
                self._turn(_LONGEST_WAIT_SECONDS)
            for loop in self._loops:
                loop.wind_up()
            clock = self._loops[0].clock
            end = clock() + _LONGEST_END_SECONDS
            while clock() < end and any(loop.is_needed for loop in self._loops):
                self._turn(_END_TURN_SECONDS)
        finally:
            for loop in self._loops:
                loop.inbox.lead(None)

    def _turn(self, longest_wait: float) -> None:
        """On the main thread: waits, then does what is due."""
        with self._turns:  # anyone who turns changes what is due
            wait = min(loop.patience(longest_wait) for loop in self._loops)
        if not self._gathers:
            if not self._waiting:
                self._changed.wait(wait)
                self._changed.clear()
            wait = 0.0
        with self._turns:
            for loop in self._loops:
                loop.turn(wait)
                wait = 0.0
            self._coalesce()

    def _coalesce(self) -> None:
        """All in the same way, since they wait together."""
        if self._loops[0].clock() >= self._next_look:
            self._next_look = self._loops[0].clock() + _LONGEST_WAIT_SECONDS
            quantum = max(loop.wanted_quantum for loop in self._loops)
            for loop in self._loops:
                loop.coalesce(quantum)

    def _came(self) -> None:
        """On the network's thread: something was put into an inbox."""
        if self._gathers:
            return
        while self._waiting and self._turns.acquire(blocking=False):
            try:
                for loop in self._loops:
                    loop.serve(0.0)
            finally:
                self._turns.release()
        self._changed.set()

    @property
    def _gathers(self) -> bool:
        return self._loops[0].quantum > 0.0

    @property
    def _waiting(self) -> bool:
        return any(loop.inbox.waiting for loop in self._loops)
