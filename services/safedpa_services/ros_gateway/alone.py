"""Whether one publisher alone speaks on a topic: of two no one knows which is right, so neither is believed."""

from __future__ import annotations

import math
from typing import final

from safedpa.ros.graph import Attachment

__all__ = ["TWO_SPEAK", "PublisherMonitor"]

TWO_SPEAK = "two publishers speak on its topic"
_ALONE_SECONDS = 1.0
"""s for which another publisher of the same topic must have been silent."""


@final
class PublisherMonitor:
    """Who spoke last, and until when nothing is believed; called on the network's thread.

    Who signs nothing counts as one publisher next to those who do: a bridge signs nothing, and is alone then.
    """

    def __init__(self) -> None:
        self._speaker: tuple[bytes | None, float] = (None, -math.inf)
        self._doubled = -math.inf

    def heard(self, alongside: Attachment | None, at: float) -> bool:
        """Takes note of a message that came at ``at`` [s]; whether it may be believed."""
        sender = b"" if alongside is None else alongside.sender
        before, last = self._speaker
        self._speaker = sender, at
        if before is not None and sender != before and at - last < _ALONE_SECONDS:
            self._doubled = at + _ALONE_SECONDS
        return not self.doubled(at)

    def doubled(self, at: float) -> bool:
        """Whether two spoke a moment before ``at`` [s]."""
        return at < self._doubled
