"""Ends a process whose work has come to a stand, so that anyone who started it starts it again."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import final

from safedpa.bus.logging import log_event

__all__ = ["LoopWatchdog"]

_LOOK_SECONDS = 0.25
_LOOKS = 20
"""In a row without a beat. They are counted, not timed: who was stopped from outside beats again before they are up."""


@final
class LoopWatchdog:
    """Hears the beats of a loop, and calls ``stands`` where none came while it looked ``looks`` times."""

    def __init__(
        self,
        stationary_for: Callable[[], None] = lambda: os._exit(1),
        *,
        look_seconds: float = _LOOK_SECONDS,
        looks: int = _LOOKS,
    ) -> None:
        self._stationary, self._look_seconds, self._looks = stationary_for, look_seconds, looks
        self._beats = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name=type(self).__name__, daemon=True)
        self._thread.start()

    def beat(self) -> None:
        """The loop goes on."""
        self._beats += 1

    def end(self) -> None:
        """Watches no more."""
        self._ended.set()

    def _watch(self) -> None:
        still, seen = 0, self._beats
        while not self._ended.wait(self._look_seconds):
            still, seen = (still + 1, seen) if self._beats == seen else (0, self._beats)
            if still >= self._looks:
                seconds = self._looks * self._look_seconds
                sentence = f"the router's own work has was stationary for {seconds:.0f} s: it ends, to be restarted"
                log_event("router.stands", sentence, level="error", service="router")
                self._stationary()
                return
