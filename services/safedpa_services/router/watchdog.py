"""Ends a process whose main loop hangs, so that its supervisor restarts it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import final

from safedpa.bus.logging import log_event

__all__ = ["LoopWatchdog"]

_LOOK_SECONDS = 0.25
_LOOKS = 20
"""Consecutive looks without a beat. Counted instead of timed: a suspended process beats again before they are over."""


@final
class LoopWatchdog:
    """Calls ``on_stall`` if a loop did not call ``beat`` during ``looks`` consecutive looks."""

    def __init__(
        self,
        on_stall: Callable[[], None] = lambda: os._exit(1),
        *,
        look_seconds: float = _LOOK_SECONDS,
        looks: int = _LOOKS,
    ) -> None:
        self._on_stall, self._look_seconds, self._looks = on_stall, look_seconds, looks
        self._beats = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name=type(self).__name__, daemon=True)
        self._thread.start()

    def beat(self) -> None:
        """Signals that the loop is running."""
        self._beats += 1

    def end(self) -> None:
        """Ends the watchdog."""
        self._ended.set()

    def _watch(self) -> None:
        stalled, seen = 0, self._beats
        while not self._ended.wait(self._look_seconds):
            stalled, seen = (stalled + 1, seen) if self._beats == seen else (0, self._beats)
            if stalled >= self._looks:
                seconds = self._looks * self._look_seconds
                sentence = f"the router's main loop has hung for {seconds:.0f} s; the process ends, to be restarted"
                log_event("router.stalled", sentence, level="error", service="router")
                self._on_stall()
                return
