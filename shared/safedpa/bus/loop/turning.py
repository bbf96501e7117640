"""Who turns the loops of a process: the thread that brings a message, or, for what no message brings, the main thread.

A message that has to wake another thread first is on its way for 100 to 150 us longer, at each of the hops from sense
to act. So the network's thread itself turns the loop when nobody else does; it never waits for the loop. With many
robots, whose messages are gathered without any thread of Python, the main thread turns alone, some hundred times a
second.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, final

if TYPE_CHECKING:
    from safedpa.bus.loop.service import ServiceLoop

__all__ = ["Turning"]

_LONGEST_WAIT_SECONDS = 0.25
_LONGEST_END_SECONDS = 5.0
"""A car brakes from full speed to a stand in 1.2 s; a container gets 10 s before it is killed."""
_END_TURN_SECONDS = 0.05


@final
class Turning:
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
        with self._turns:  # whoever turns changes what is due
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
