"""The page's place on the bus: listens, asks, and never writes a command."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from safedpa.bus import FINDING, HEALTH, MODEL, STATE, TAKEOVER, VERDICT, Answer, Bus, Request
from safedpa.errors import MessageError
from safedpa_services.workbench.live_book import LiveStore

__all__ = ["LiveLink", "QueryResult"]

_PATIENCE = 2.0
"""s until an answer has to be there."""


@dataclass(frozen=True)
class QueryResult:
    """What a question brought: an answer, or in words why there is none."""

    answer: Answer | None
    sentence: str

    @property
    def ok(self) -> bool:
        """Whether it was answered and done."""
        return self.answer is not None and self.answer.ok


class LiveLink:
    """One participant that only listens and asks, for all tabs of the page."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._inbox = bus.inbox((STATE, VERDICT, FINDING, MODEL, TAKEOVER, HEALTH))
        self.book = LiveStore()
        self.ended = False
        """Whether the drive has ended, and this page's server with it."""
        self.untold: set[object] = set()
        """Pages whose browser does not know that yet."""

    @property
    def title(self) -> str:
        """What is listened to."""
        return f"fleet {self._bus.fleet}"

    def listen(self) -> None:
        """Takes in what arrived; never waits."""
        self.book.take(self._inbox.take(0.0))

    async def ask(self, robot: str, request: Request) -> QueryResult:
        """Asks the diagnosis; no answer and one that is none are told in words."""
        try:
            answer = await asyncio.to_thread(self._bus.request, robot, request, _PATIENCE)
        except MessageError as error:
            return QueryResult(
                None, f"The diagnosis gave an answer that is none ({error}); nothing was changed by this page."
            )
        if answer is None:
            return QueryResult(None, "No diagnosis answers; nothing was changed. Does 'safedpa up' run?")
        return QueryResult(answer, answer.sentence)
