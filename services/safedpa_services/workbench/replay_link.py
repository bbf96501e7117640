"""A recorded drive in place of a bus: the live page shows it as if it drove now."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from safedpa.bus import Answer, Message, ReceivedMessage, Request
from safedpa.bus.messages.topics import topic_of
from safedpa.errors import RunError
from safedpa.records import read_messages
from safedpa_services.workbench.live_book import LiveStore
from safedpa_services.workbench.live_link import QueryResult

__all__ = ["ReplayLink"]

_RECORDED = "this is a recording: nothing can be changed"


class ReplayLink:
    """Plays the messages of a recording of the bus at the pace of the robot's clock.

    Raises RunError when the file is no such recording or holds no message.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._entries: Iterator[tuple[str, int, Message]] = iter(read_messages(path))
        self._clock = clock
        self._next = next(self._entries, None)
        if self._next is None:
            raise RunError(f"{path}: holds no message; wanted a recording of the bus (.mcap)")
        self._began = clock() - self._next[2].robot_time
        self.title = f"recording {path.name}"
        self.book = LiveStore()
        self.ended = False
        self.untold: set[object] = set()

    def listen(self) -> None:
        """Takes in what was said up to now, by the robot's clock."""
        now = self._clock()
        while self._next is not None and self._next[2].robot_time <= now - self._began:
            key, _, message = self._next
            _, robot, topic = topic_of(key)
            self.book.take([ReceivedMessage(topic, robot, message, b"", key, now)])
            self._next = next(self._entries, None)

    async def ask(self, robot: str, request: Request) -> QueryResult:
        """Tells the candidates of the last report; refuses everything else."""
        if request.do != "status":
            return QueryResult(Answer(ok=False, sentence=f"refused: {_RECORDED}"), f"Refused: {_RECORDED}.")
        book = self.book.robots.get(robot)
        report = None if book is None else book.report
        entries = [] if report is None else [item for item in report["candidates"] if isinstance(item, dict)]
        names = [
            str(item.get("effect")) for item in entries if item.get("stage") == 0 and item.get("decision") in _RETAINED
        ]
        return QueryResult(Answer(ok=True, sentence=_RECORDED, candidates=tuple(names)), _RECORDED)


_RETAINED = ("accepted", "suspected")
