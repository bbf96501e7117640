"""Scheduling of the service loops of a process: timers by robot, batching, and the thread that runs the loops.

Batching: with many robots, a loop handles messages in batches, a few hundred times a second, like interrupt coalescing
in network cards. A message that wakes a process on its own takes several times the CPU time of one in a batch: two
thread switches, cold caches, and a separate packet for the answer. With one robot no message waits. With many, each
loop between sense and act adds at most one batch interval to the latency, which may reach 0.9 of the period.

Threads: the thread that delivers a message runs the loop itself, unless another thread does so; it never waits for the
loop. Waking another thread would add 100 to 150 us at each hop from sense to act. Work that no message triggers runs on
the main thread. In batch mode, messages gather outside Python and only the main thread runs the loops.
"""

from __future__ import annotations

import heapq
import threading
from collections.abc import Callable, Sequence
from math import inf
from typing import TYPE_CHECKING, final

if TYPE_CHECKING:
    from safedpa.bus.service.service_loop import ServiceLoop

# Longest wait for a message; also the interval at which `stopped` and the batch interval are checked.
_LONGEST_WAIT_SECONDS = 0.25
# Time limit of the shutdown: a car brakes from full speed in 1.2 s, and Docker kills a container after 10 s.
_SHUTDOWN_SECONDS = 5.0
# Longest wait while shutting down, so that the process ends soon after the last robot has stopped.
_SHUTDOWN_WAIT_SECONDS = 0.05


@final
class TimerQueue:
    """Timers [s] by robot. A timer cannot be cancelled; handling a robot once too often is cheap."""

    # Robots that are served together have equal due times, so the heap has one entry for all of them.

    def __init__(self) -> None:
        self._times: list[float] = []
        self._robots: dict[float, list[str]] = {}
        """Robots by due time."""

    def at(self, when: float, robot: str) -> None:
        """Adds a timer; an infinite time is ignored."""
        robots = self._robots.get(when)
        if robots is not None:
            robots.append(robot)
        elif when < inf:
            self._robots[when] = [robot]
            heapq.heappush(self._times, when)

    def due(self, now: float) -> list[str]:
        """Removes and returns the robots whose timers are due, earliest first, each once."""
        times = self._times
        if not times or times[0] > now:
            return []
        found: dict[str, None] = {}
        while times and times[0] <= now:
            found.update(dict.fromkeys(self._robots.pop(heapq.heappop(times))))
        return list(found)

    def next(self, awaited: Callable[[str], bool] | None = None) -> float:
        """Returns the earliest due time; infinite without timers.

        Removes timers of which no robot satisfies ``awaited``, so that the loop does not wake up for them.
        """
        times = self._times
        while awaited is not None and times and not any(map(awaited, self._robots[times[0]])):
            del self._robots[heapq.heappop(times)]
        return times[0] if times else inf

    def __len__(self) -> int:
        return sum(map(len, self._robots.values()))


# Number of robots from which batching is used, and below which it ends again: hysteresis.
_MANY, _FEW = 8, 4
# Batch interval as a fraction of the shortest period: 1.5 ms at 20 Hz. Four loops wait in sequence. A fraction of 0.08
# tripled the latency of fifty robots and saved no CPU time.
_SHARE = 0.03
# Below this interval, the overhead of sleeping exceeds the savings.
_SHORTEST_SECONDS = 0.001
MAX_HOLD_SECONDS = 0.005
"""Longest time that an output waits for the outputs of other robots."""


def batch_interval(periods: Sequence[float], *, coalescing: bool) -> float:
    """Returns the batch interval [s] for robots with these periods [s]; 0: no batching.

    The period of a robot in lockstep is 0, which turns batching off, because the robot waits for every answer.
    ``coalescing`` is whether batching is on now.
    """
    if len(periods) < (_FEW if coalescing else _MANY):
        return 0.0
    quantum = _SHARE * min(periods)
    return quantum if quantum >= _SHORTEST_SECONDS else 0.0


@final
class Scheduler:
    """Runs the service loops of one process, in the given order, which is the order of the data flow."""

    def __init__(self, loops: Sequence[ServiceLoop]) -> None:
        self._loops = loops
        self._running = threading.Lock()
        """Held by the thread that runs the loops."""
        self._next_check = 0.0
        """Time [s] at which the batch interval is computed again."""
        self._changed = threading.Event()
        """Set when another thread has run the loops, after which other timers may be due first."""

    def run(self, stopped: Callable[[], bool]) -> None:
        """Runs until ``stopped``, then until no active robot needs a service, for at most 5 s.

        Checks ``stopped`` four times a second.
        """
        for loop in self._loops:
            loop.inbox.set_listener(self._on_arrival)
        try:
            while not stopped():
                self._turn(_LONGEST_WAIT_SECONDS)
            for loop in self._loops:
                loop.begin_shutdown()
            # The filter keeps braking its robots meanwhile; leaving at once would hand each over to its own watchdog.
            clock = self._loops[0].clock
            end = clock() + _SHUTDOWN_SECONDS
            while clock() < end and any(loop.is_needed for loop in self._loops):
                self._turn(_SHUTDOWN_WAIT_SECONDS)
        finally:
            for loop in self._loops:
                loop.inbox.set_listener(None)

    def _turn(self, longest_wait: float) -> None:
        """Waits, then runs the loops; on the main thread."""
        with self._running:  # the thread that runs the loops changes their timers
            wait = min(loop.wait_time(longest_wait) for loop in self._loops)
        # In batch mode the first loop's inbox sleeps for the rest of the interval instead.
        if not self._gathers:
            # If a message arrives between this check and the wait, the event is set and the wait returns at once.
            if not self._waiting:
                self._changed.wait(wait)
                self._changed.clear()
            wait = 0.0
        with self._running:
            for loop in self._loops:
                loop.turn(wait)
                wait = 0.0  # only the first loop waits; the others would wait for the same time again
            self._coalesce()

    def _coalesce(self) -> None:
        """Sets the same batch interval for all loops, because they share one wait."""
        if self._loops[0].clock() >= self._next_check:
            self._next_check = self._loops[0].clock() + _LONGEST_WAIT_SECONDS
            quantum = max(loop.preferred_quantum for loop in self._loops)
            for loop in self._loops:
                loop.coalesce(quantum)

    def _on_arrival(self) -> None:
        """Runs the loops after a message arrived; on the network's thread."""
        if self._gathers:
            return
        # Never block the network's thread. If another thread holds the lock, it takes this message, or the main thread
        # does in its next turn. Checked in a loop, because a message may arrive just before the lock is released.
        while self._waiting and self._running.acquire(blocking=False):
            try:
                for loop in self._loops:
                    loop.serve(0.0)
            finally:
                self._running.release()
        self._changed.set()  # the main thread computes its wait again

    @property
    def _gathers(self) -> bool:
        return self._loops[0].quantum > 0.0

    @property
    def _waiting(self) -> bool:
        return any(loop.inbox.waiting for loop in self._loops)
