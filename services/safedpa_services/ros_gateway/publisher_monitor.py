"""Detects second publishers.

On a topic that the gateway reads it is unknown which of two is right, so the messages of both are refused. The driver
obeys every command on its topic, even those of a publisher that is not announced.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import final

from safedpa.ros.graph import Attachment

TWO_PUBLISHERS = "two publishers send on its topic"
_ALONE_SECONDS = 1.0
"""Time for which a second publisher must have been silent [s]."""


@final
class PublisherMonitor:
    """Tracks the publisher of a topic by the sender id in its messages' attachments; called on the network's thread.

    Messages without an attachment count as one publisher, because a bridge sends none.
    """

    def __init__(self) -> None:
        self._last_publisher: tuple[bytes | None, float] = (None, -math.inf)
        self._two_until = -math.inf

    def accept(self, attachment: Attachment | None, at: float) -> bool:
        """Notes a message that arrived at ``at`` [s]; returns whether it may be used."""
        sender = b"" if attachment is None else attachment.sender
        before, last = self._last_publisher
        self._last_publisher = sender, at
        if before is not None and sender != before and at - last < _ALONE_SECONDS:
            self._two_until = at + _ALONE_SECONDS
        return not self.has_two(at)

    def has_two(self, at: float) -> bool:
        """Returns whether two publishers sent within the last second before ``at`` [s]."""
        return at < self._two_until


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
        self.answer: Callable[[], object] = lambda: None

    def take(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message of another session, on the network's thread."""
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
