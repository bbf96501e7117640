"""Detects a second publisher on a topic: it is unknown which of two is right, so the messages of both are refused."""

from __future__ import annotations

import math
from typing import final

from safedpa.ros.graph import Attachment

__all__ = ["TWO_PUBLISHERS", "PublisherMonitor"]

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
