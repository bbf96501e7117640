"""Detects commands of other publishers on the driver's topic, which the driver obeys even if they are not announced."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import final

from safedpa.ros.graph import Attachment

__all__ = ["CommandEchoMonitor"]

_SILENT_SECONDS = 1.0
"""Time without a message after which another publisher counts as gone [s]."""
_ANSWER_SECONDS = 0.001
"""Shortest time between two answers [s]; limits the effect of a flood."""


@final
class CommandEchoMonitor:
    """Notes the last command of another publisher; ``answer`` is called for each, on the network's thread."""

    def __init__(self, topic: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._topic, self._clock = topic, clock
        self._last = (-math.inf, "")
        self._answered = -math.inf
        self.answer: Callable[[], None] = _nothing

    def take(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message of another session, on the network's thread."""
        del data
        sender = f"sender {attachment.sender.hex()[:8]}" if attachment is not None else "unknown sender"
        now = self._clock()
        self._last = now, sender
        if now - self._answered >= _ANSWER_SECONDS:
            self._answered = now
            self.answer()

    @property
    def why(self) -> str:
        """Sentence about the other publisher; empty if there is none."""
        at, sender = self._last
        if self._clock() - at > _SILENT_SECONDS:
            return ""
        return f"an unannounced publisher ({sender}) sends on {self._topic}, too; find and end it"


def _nothing() -> None:
    """Default of ``answer``."""
