"""Who else speaks on the driver's topic, by what is heard there: a publisher need not announce itself to be obeyed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import final

from safedpa.ros.graph import Attachment

__all__ = ["CommandEchoMonitor"]

_SILENT_SECONDS = 1.0
"""s without a word after which it counts as gone."""
_ANSWER_SECONDS = 0.001
"""At most so often a word is answered, anyone who floods the topic."""


@final
class CommandEchoMonitor:
    """The last command that came from elsewhere; ``answer`` is called for each, on the network's thread."""

    def __init__(self, topic: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._topic, self._clock = topic, clock
        self._last = (-math.inf, "")
        self._answered = -math.inf
        self.answer: Callable[[], None] = _nothing

    def take(self, data: bytes, alongside: Attachment | None = None) -> None:
        """One message of another session, on the network's thread."""
        del data
        sender = f"sender {alongside.sender.hex()[:8]}" if alongside is not None else "a sender without a name"
        now = self._clock()
        self._last = now, sender
        if now - self._answered >= _ANSWER_SECONDS:
            self._answered = now
            self.answer()

    @property
    def why(self) -> str:
        """A sentence while someone speaks there; empty else."""
        at, sender = self._last
        if self._clock() - at > _SILENT_SECONDS:
            return ""
        return f"someone who shows no token ({sender}) publishes on {self._topic} too; find and end it"


def _nothing() -> None:
    """Before anybody asked for answers."""
