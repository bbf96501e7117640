"""The sources of the live page: a bus, to which it sends requests but never a command, or a recording in its place."""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from safedpa.bus import (
    FINDING,
    HEALTH,
    MODEL,
    STATE,
    TAKEOVER,
    VERDICT,
    Answer,
    Bus,
    Message,
    ReceivedMessage,
    Request,
)
from safedpa.bus.messages.topics import topic_of
from safedpa.errors import MessageError, RunError
from safedpa.records import read_messages
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


class AbstractLink(ABC):
    """A source of messages that all tabs of the live page share."""

    def __init__(self, title: str) -> None:
        self.title = title
        """Name of the source, shown on the page."""
        self.store = LiveStore()
        self.ended = False
        """Whether the drive has ended; the server ends shortly afterwards."""
        self.pages_to_notify: set[object] = set()
        """Pages whose browser does not show the end of the drive yet."""

    @abstractmethod
    def listen(self) -> None:
        """Stores the messages that are there; does not block."""

    @abstractmethod
    async def ask(self, robot: str, request: Request) -> QueryResult:
        """Sends a request to the diagnosis."""


class LiveLink(AbstractLink):
    """The connection to a bus."""

    def __init__(self, bus: Bus) -> None:
        super().__init__("one fleet" if bus.fleet == "fleet" else f"fleet {bus.fleet}")
        self._bus = bus
        self._inbox = bus.inbox((STATE, VERDICT, FINDING, MODEL, TAKEOVER, HEALTH))

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


_READ_ONLY = "this is a recording: nothing can be changed"
_SHOWN_DECISIONS = ("accepted", "suspected")


class ReplayLink(AbstractLink):
    """Replays the messages of a bus recording in real time, by the robot's clock.

    Raises RunError if the file is not a recording of the bus or contains no message.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(f"recording {path.name}")
        self._entries: Iterator[tuple[str, int, Message]] = iter(read_messages(path))
        self._clock = clock
        self._next = next(self._entries, None)
        if self._next is None:
            raise RunError(f"{path}: contains no message; wanted a recording of the bus (.mcap)")
        self._began = clock() - self._next[2].robot_time

    def listen(self) -> None:
        """Stores the messages up to the present replay time."""
        now = self._clock()
        while self._next is not None and self._next[2].robot_time <= now - self._began:
            key, _, message = self._next
            _, robot, topic = topic_of(key)
            self.store.update([ReceivedMessage(topic, robot, message, b"", key, now)])
            self._next = next(self._entries, None)

    async def ask(self, robot: str, request: Request) -> QueryResult:
        """Answers "status" with the candidates of the last report; refuses every other request."""
        if request.do != "status":
            return QueryResult(Answer(ok=False, sentence=f"refused: {_READ_ONLY}"), f"Refused: {_READ_ONLY}.")
        history = self.store.robots.get(robot)
        report = None if history is None else history.report
        entries = [] if report is None else [item for item in report["candidates"] if isinstance(item, dict)]
        shown = [item for item in entries if item.get("stage") == 0 and item.get("decision") in _SHOWN_DECISIONS]
        names = tuple(str(item.get("effect")) for item in shown)
        return QueryResult(Answer(ok=True, sentence=_READ_ONLY, candidates=names), _READ_ONLY)
