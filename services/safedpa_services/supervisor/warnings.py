"""What the processes of a loop warn of, gathered from their logs for a person to read; a flood stays a few lines."""

from __future__ import annotations

import contextlib
import json
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from safedpa.errors import InputError
from safedpa.limits import parse_json
from safedpa.limits import readable as plain
from safedpa_services.supervisor.child import Child

__all__ = ["Warnings", "readable"]

_LOOK_SECONDS = 0.5
_MOST_BYTES = 65536
"""Read at one look of one log; a process that writes more is not read to the end."""
_LONGEST_LINE = 500
"""Letters."""
_SHOWN = 4
_LEAST_SECONDS = 5.0
"""Between two lines of the same kind, process and robot."""
_MOST_LINES = 12
"""Within that time; whatever else there is stands in the logs."""


class Warnings:
    """Reads on in the children's logs; tells their warnings, and what died and was started again.

    ``reported`` gets every line that is worth a person's look; the newest ones are also kept.
    """

    def __init__(self, children: Sequence[Child], folder: Path, reported: Callable[[str], None] | None = None) -> None:
        self._children, self._reported = children, reported
        self._read: dict[str, int] = {}
        self._restarts = {child.name: 0 for child in children}
        self._next_look = 0.0
        self._written: dict[tuple[str, str, str], float] = {}
        self._own_log = folder / "supervisor.log"
        self.newest: deque[str] = deque(maxlen=_SHOWN)

    def look(self) -> None:
        """Call it often; it looks twice a second."""
        if time.monotonic() < self._next_look:
            return
        self._next_look = time.monotonic() + _LOOK_SECONDS
        for child in self._children:
            for event in self._new_events(child):
                self._report(event)
            if child.restarts > self._restarts[child.name]:
                self._restarts[child.name] = child.restarts
                self._report(self._restarted(child))

    def _restarted(self, child: Child) -> dict[str, Any]:
        event = {
            "time": round(time.time(), 3),
            "level": "warning",
            "kind": "child.restarted",
            "sentence": f"{child.name} died or hung and was started again ({child.restarts} times so far)",
            "service": child.name,
            "pid": child.pid,
        }
        with contextlib.suppress(OSError), self._own_log.open("a", encoding="utf-8") as log:  # no log ends a loop
            log.write(json.dumps(event) + "\n")
        return event

    def _new_events(self, child: Child) -> list[dict[str, Any]]:
        """What stands in the log since the last look, as far as whole lines go."""
        begin = self._read.get(child.name, 0)
        try:
            with child.log.open("rb") as file:
                file.seek(begin)
                new = file.read(_MOST_BYTES)
        except OSError:  # not started yet, or the folder is gone: nothing to tell
            return []
        whole = new[: new.rfind(b"\n") + 1]
        self._read[child.name] = begin + len(whole) if whole or len(new) < _MOST_BYTES else begin + len(new)
        events = [_event(line) for line in whole.decode(errors="replace").splitlines()]
        return [event for event in events if event is not None]

    def _report(self, event: dict[str, Any]) -> None:
        key = (str(event.get("kind")), str(event.get("service", "")), str(event.get("robot", "")))
        now = time.monotonic()
        self._written = {known: at for known, at in self._written.items() if now - at < _LEAST_SECONDS}
        if key in self._written or len(self._written) >= _MOST_LINES:
            return
        self._written[key] = now
        line = readable(event)
        self.newest.append(line)
        if self._reported is not None:
            self._reported(line)


def _event(line: str) -> dict[str, Any] | None:
    """The event in a line; None where it is none, or one that is no warning."""
    if not line.startswith("{"):
        return None
    try:
        event = parse_json(line)
    except InputError:
        return None
    return event if isinstance(event, dict) and event.get("level") in ("warning", "error") else None


def readable(event: dict[str, Any]) -> str:
    """One line for a person: time, process, robot and tick, sentence."""
    stamp = time.strftime("%H:%M:%S", time.localtime(float(event.get("time", 0.0))))
    about = [str(event[name]) for name in ("service", "robot") if event.get(name)]
    about += [f"tick {event['tick']}"] if "tick" in event else []
    sentence = " ".join(str(event.get("sentence", "")).split())
    return plain(f"{stamp} {' '.join(about)}: {sentence}" if about else f"{stamp} {sentence}", _LONGEST_LINE)
