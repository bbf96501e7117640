"""Replays a recorded drive on the live page, in place of a bus."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from safedpa.bus import Answer, Message, ReceivedMessage, Request
from safedpa.bus.messages.topics import topic_of
from safedpa.errors import RunError
from safedpa.records import read_messages
from safedpa_services.workbench.live.bus_link import QueryResult
from safedpa_services.workbench.live.store import LiveStore

_READ_ONLY = "this is a recording: nothing can be changed"


class ReplayLink:
    """Replays the messages of a bus recording in real time, by the robot's clock.

    Raises RunError if the file is not a recording of the bus or contains no message.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._entries: Iterator[tuple[str, int, Message]] = iter(read_messages(path))
        self._clock = clock
        self._next = next(self._entries, None)
        if self._next is None:
            raise RunError(f"{path}: contains no message; wanted a recording of the bus (.mcap)")
        self._began = clock() - self._next[2].robot_time
        self.title = f"recording {path.name}"
        self.store = LiveStore()
        self.ended = False
        self.pages_to_notify: set[object] = set()

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
        names = [
            str(item.get("effect"))
            for item in entries
            if item.get("stage") == 0 and item.get("decision") in _SHOWN_DECISIONS
        ]
        return QueryResult(Answer(ok=True, sentence=_READ_ONLY, candidates=tuple(names)), _READ_ONLY)


_SHOWN_DECISIONS = ("accepted", "suspected")
