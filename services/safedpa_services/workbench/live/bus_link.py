"""Connects the live page to a bus: receives messages and sends requests, but never a command."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from safedpa.bus import FINDING, HEALTH, MODEL, STATE, TAKEOVER, VERDICT, Answer, Bus, Request
from safedpa.errors import MessageError
from safedpa_services.workbench.live.store import LiveStore

_TIMEOUT = 2.0
"""s to wait for the answer to a request."""


@dataclass(frozen=True)
class QueryResult:
    """Result of a request: the answer, or the reason why there is none."""

    answer: Answer | None
    sentence: str

    @property
    def ok(self) -> bool:
        """Whether the request was answered and carried out."""
        return self.answer is not None and self.answer.ok


class LiveLink:
    """The bus connection that all tabs of the live page share."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._inbox = bus.inbox((STATE, VERDICT, FINDING, MODEL, TAKEOVER, HEALTH))
        self.store = LiveStore()
        self.ended = False
        """Whether the drive has ended; the server ends shortly afterwards."""
        self.pages_to_notify: set[object] = set()
        """Pages whose browser does not show the end of the drive yet."""

    @property
    def title(self) -> str:
        """Name of the message source, shown on the page."""
        return f"fleet {self._bus.fleet}"

    def listen(self) -> None:
        """Stores the received messages; does not block."""
        self.store.update(self._inbox.take(0.0))

    async def ask(self, robot: str, request: Request) -> QueryResult:
        """Sends a request to the diagnosis; a missing or invalid answer becomes a sentence in the result."""
        try:
            answer = await asyncio.to_thread(self._bus.request, robot, request, _TIMEOUT)
        except MessageError as error:
            return QueryResult(None, f"The diagnosis sent an invalid answer ({error}); this page changed nothing.")
        if answer is None:
            return QueryResult(None, "No diagnosis answers; nothing was changed. Is 'safedpa up' running?")
        return QueryResult(answer, answer.sentence)
