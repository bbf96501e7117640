"""Collects warnings from the logs of a run's processes for the user; the number of lines is limited."""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from safedpa.errors import InputError
from safedpa.limits import parse_json
from safedpa.limits import readable as plain
from safedpa_services.supervisor.child import Child

_LOOK_SECONDS = 0.5
_MOST_BYTES = 65536
"""Read per log and look; more than that is read later or, without a line end, skipped."""
_LONGEST_LINE = 500
"""Characters."""
_SHOWN = 4
_REPEAT_SECONDS = 5.0
"""Shortest time between two lines of the same kind, process and robot."""
_MOST_LINES = 12
"""Lines within that time; further warnings are in the logs only."""


class LogWarnings:
    """Follows the logs of child processes and reports their warnings, their restarts, and who is missing.

    ``notices`` are sentences about who is missing and who returned (``RunMonitor.notices``); they are removed from it.

    Each line goes to the callback ``on_warning``; ``newest`` holds the last ones.
    """

    def __init__(
        self,
        children: Sequence[Child],
        folder: Path,
        on_warning: Callable[[str], None] | None = None,
        notices: deque[str] | None = None,
    ) -> None:
        self._children, self._on_warning = children, on_warning
        self._notices = deque[str]() if notices is None else notices
        self._read: dict[str, int] = {}
        self._restarts = {child.name: 0 for child in children}
        self._given_up: set[str] = set()
        self._next_look = 0.0
        self._written: dict[tuple[str, str, str], float] = {}
        self._own_log = folder / "supervisor.log"
        self.newest: deque[str] = deque(maxlen=_SHOWN)

    def look(self) -> None:
        """Reads new log lines, at most twice a second; call it often."""
        if time.monotonic() < self._next_look:
            return
        self._next_look = time.monotonic() + _LOOK_SECONDS
        for child in self._children:
            for event in self._new_events(child):
                self._report(event)
            child.rotate_log()
            if child.restarts > self._restarts[child.name]:
                self._restarts[child.name] = child.restarts
                self._note("child.restarted", _restarted(child), child)
            if child.given_up and child.name not in self._given_up:
                self._given_up.add(child.name)
                self._note("child.given_up", f"{child.name} is not restarted any more: {child.cause}", child)
        while self._notices:
            self._note("roster.changed", self._notices.popleft(), None)

    def _note(self, kind: str, sentence: str, child: Child | None) -> None:
        """Writes an event of the supervisor itself to its log, and reports it."""
        about = {} if child is None else {"service": child.name, "pid": child.pid}
        event = {"time": round(time.time(), 3), "level": "warning", "kind": kind, "sentence": sentence, **about}
        # a log that cannot be written must not end the run
        with contextlib.suppress(OSError), self._own_log.open("a", encoding="utf-8") as log:
            log.write(json.dumps(event) + "\n")
        self._report(event, key=sentence if child is None else "")

    def _new_events(self, child: Child) -> list[dict[str, Any]]:
        """Returns the warnings in the whole lines that were written since the last look."""
        begin = self._read.get(child.name, 0)
        try:
            with child.log.open("rb") as file:
                if file.seek(0, os.SEEK_END) < begin:  # it was emptied
                    begin = 0
                file.seek(begin)
                new = file.read(_MOST_BYTES)
        except OSError:  # not started yet, or the folder was removed
            return []
        whole = new[: new.rfind(b"\n") + 1]
        self._read[child.name] = begin + len(whole) if whole or len(new) < _MOST_BYTES else begin + len(new)
        events = [_event(line) for line in whole.decode(errors="replace").splitlines()]
        return [event for event in events if event is not None]

    def _report(self, event: dict[str, Any], key: str = "") -> None:
        which = (str(event.get("kind")), str(event.get("service", "")), key or str(event.get("robot", "")))
        now = time.monotonic()
        self._written = {known: at for known, at in self._written.items() if now - at < _REPEAT_SECONDS}
        if which in self._written or len(self._written) >= _MOST_LINES:
            return
        self._written[which] = now
        line = readable(event)
        self.newest.append(line)
        if self._on_warning is not None:
            self._on_warning(line)


def _restarted(child: Child) -> str:
    cause = f"; {child.cause}" if child.cause else ""
    return f"{child.name} was restarted ({child.restarts} times so far){cause}"


def _event(line: str) -> dict[str, Any] | None:
    """Returns the event in a line; None unless it is a warning or an error."""
    if not line.startswith("{"):
        return None
    try:
        event = parse_json(line)
    except InputError:
        return None
    return event if isinstance(event, dict) and event.get("level") in ("warning", "error") else None


def readable(event: dict[str, Any]) -> str:
    """Returns an event as one line: time, process, robot, tick and sentence."""
    stamp = time.strftime("%H:%M:%S", time.localtime(float(event.get("time", 0.0))))
    about = [str(event[name]) for name in ("service", "robot") if event.get(name)]
    about += [f"tick {event['tick']}"] if "tick" in event else []
    sentence = " ".join(str(event.get("sentence", "")).split())
    return plain(f"{stamp} {' '.join(about)}: {sentence}" if about else f"{stamp} {sentence}", _LONGEST_LINE)
