"""The structured event log: one line per event on standard error, and the catalogue of event kinds.

A line is a JSON object with ``time`` (Unix time in s), ``level``, ``kind`` (dotted and stable, for programs),
``sentence`` and, where they apply, ``robot``, ``tick``, ``service`` and further fields of the event. On a terminal, or
with ``SAFEDPA_LOG=text``, it is one readable line of text instead.

The rate is limited: of the events with the same kind, robot and service only the first within a second is written.
At the end of the second the newest of the others is written with ``repeated``, the number of events left out.
"""

from __future__ import annotations

import contextlib
import heapq
import json
import os
import sys
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from types import MappingProxyType
from typing import Any, final

from safedpa.limits import printable

KINDS = MappingProxyType(
    {
        "process.started": "A process joined the bus.",
        "process.ended": "A process shuts down in order; the sentence names the signal.",
        "child.restarted": "The supervisor restarts a process that died, or that it killed because it hung.",
        "child.given_up": "A process ended too often and is not restarted any more; the sentence has the cause.",
        "roster.changed": "A robot or service of the run is missing, has returned, or was dismissed by a person.",
        "robot.met": "A service receives the first state of a robot.",
        "robot.restarted": "A robot sends a new epoch: it was restarted.",
        "robot.forgotten": "A robot was silent for so long that a service drops its data.",
        "robot.second_refused": "A second robot uses a name that is already in use; its messages are ignored.",
        "robot.other_type": "A publisher of nominal actions has another type than configured.",
        "robot.confirmed_pose": "A pose of the declared localisation agrees with an implausible state, or does not.",
        "robot.zone": "Another speed zone of the gateway limits the robot; the sentence names it.",
        "message.refused": "A message was malformed or out of order; the sentence says why.",
        "filter.fallback_entered": "The safety filter cannot decide and brakes; the sentence says why.",
        "filter.fallback_left": "The safety filter decides again; the sentence has the number of ticks in between.",
        "filter.disabled": "The safety filter is switched off and passes nominal actions on unchecked.",
        "filter.stopped": "A robot is stopped by an order or because the filter shuts down.",
        "filter.released": "A robot that was stopped may drive again.",
        "order.taken": "A user ordered robots to stop or to go, or switched a source or a zone.",
        "order.refused": "An order was refused; the sentence says why.",
        "order.restored": "The filter or perception was started and found a stored order that is still in force.",
        "order.lost": "Perception cannot read its stored orders: all sources are off until one is switched on.",
        "perception.ignores": "Objects in the named zones are not reported for a robot, by configuration or order.",
        "perception.source_off": "The named sources of a robot are switched off, by configuration or order.",
        "perception.source_unknown": "Perception's configuration names sources that the robot does not have.",
        "perception.switched": "Other sources or zones of a robot are active from the named tick on.",
        "model.offered": "The diagnosis offers a new model of a robot to the services.",
        "model.decided": "All services are ready; the new model is active from the named tick on.",
        "model.dropped": "An offered model is discarded; the sentence says why.",
        "model.ready": "A service has loaded and checked the offered model.",
        "model.taken": "A service uses the new model.",
        "model.refused": "A service cannot use the offered model; the sentence says why.",
        "finding.changed": "The diagnosis enters another stage: raised, searching, candidates, nothing, watching.",
        "recorder.failed": "The recording was interrupted; the sentence says why.",
        "recorder.resumed": "The recording continues in another file, because the disk has free space again.",
        "recorder.lost": "The recorder could not keep up; the sentence has the number of lost messages.",
        "dashboard.file_stopped": "The disk is almost full: the dashboard writes no file any more; its page goes on.",
        "dashboard.file_resumed": "The disk has free space again: the dashboard writes another file.",
        "lease.waiting": "A second safety filter waits for the lease of the active one.",
        "lease.taken": "A safety filter holds the lease and serves robots from now on.",
        "lease.lost": "A safety filter could not renew its lease in time: it ends, and another one takes over.",
        "router.open": "The router accepts connections.",
        "router.stalled": "The router makes no progress; it exits, so that it is restarted.",
        "bus.plain_text": "The bus can be reached from other machines without certificates.",
        "bus.not_rejoined": "A suspended process could not open a new bus session; the old one retries its links.",
        "bus.unclosed": "A process exits although its bus session did not close in time; its links close with it.",
        "bus.key_exposed": "A private key can be read by every user of the machine.",
        "bus.misrouted": "A message was delivered under a wrong key after a lost link; it is ignored.",
        "bus.duplicate_certificate": "Two connections use one certificate; one of them may be an impostor.",
        "bus.joined": "A client connected to the router with a certificate.",
        "bus.handshake_refused": "The router refused a connection.",
        "bus.denied": "A client tried something that its role does not permit; the router blocked it.",
        "bus.too_large": "A client sent a message above the size limit of its topic; the router blocked it.",
        "bus.held_back": "A client sends faster than any robot ticks; the router drops some of its messages.",
        "bus.strangers_cut_off": "Connections were closed that did not authenticate in time.",
        "bus.revoked": "Links of expired or revoked certificates were closed.",
        "page.refused": "A web request had a wrong origin, host name or token, or was too large.",
        "page.wrong_password": "A user entered a wrong password on a web page.",
        "bus.log_overrun": "More events were refused than could be logged one by one.",
        "bus.zenoh": "A warning of the Zenoh library.",
    }
)
"""Meaning of each event kind. Kinds are stable: programs that watch the log may rely on them."""


_RATE_WINDOW_SECONDS = 1.0
# Combinations of kind, robot and service whose rate is tracked. Robot names may come from an attacker, and each one
# would take memory.
_MOST_WINDOWS = 512
# Characters of one value. Names and error texts may come from the network.
_LONGEST_TEXT = 400

Later = Callable[[float, Callable[[], None]], object]


# Kind, robot, service: repeated events of one robot must not suppress those of another.
_Key = tuple[str, str, str]


@dataclass
class _Window:
    """The interval after a written line in which further events of the same key are counted only."""

    opened: float
    """Time of the last written line in s, by the log's clock."""
    left_out: int = 0
    newest: dict[str, Any] | None = None


def _to_standard_error(line: str) -> None:
    # Standard error may be closed, a broken pipe, or None. Logging must never stop a control loop.
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stderr.write(line)
        sys.stderr.flush()


@final
class DelayedCaller:
    """Calls functions after a delay, all in one thread, which ends when none is left.

    With a thread per call, a hundred robots with changing verdicts would start two hundred threads a second in a
    service that is already late.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        """Heap by due time [s, monotonic clock]; the sequence number breaks ties, since functions have no order."""
        self._number = count()
        self._thread: threading.Thread | None = None

    def __call__(self, seconds: float, work: Callable[[], None]) -> None:
        """Calls ``work`` after ``seconds``; immediately if that is negative."""
        with self._changed:
            heapq.heappush(self._due, (time.monotonic() + seconds, next(self._number), work))
            # Not alive in a fork: the thread exists only in the parent process.
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._run, name="safedpa-alarm", daemon=True)
                self._thread.start()
            elif self._due[0][2] is work:
                self._changed.notify()

    def _run(self) -> None:
        while (work := self._next()) is not None:
            try:
                work()
            except Exception:  # noqa: BLE001
                # Report it like an uncaught exception of a thread, and continue with the other functions.
                sys.excepthook(*sys.exc_info())

    def _next(self) -> Callable[[], None] | None:
        """Waits for the next due function; None if there is none left."""
        with self._changed:
            while self._due:
                left = self._due[0][0] - time.monotonic()
                if left <= 0.0:
                    return heapq.heappop(self._due)[2]
                self._changed.wait(left)
            # Set under the lock: a call that follows sees that it has to start another thread.
            self._thread = None
            return None


class EventLog:
    """Writes events to ``write``, rate limited; ``clock`` [s] and ``later(seconds, function)`` time the limit."""

    def __init__(
        self,
        write: Callable[[str], object] = _to_standard_error,
        clock: Callable[[], float] = time.monotonic,
        later: Later | None = None,
    ) -> None:
        self._write, self._clock, self._later = write, clock, later or DelayedCaller()
        self._lock = threading.Lock()
        self._windows: OrderedDict[_Key, _Window] = OrderedDict()
        self._counts: Counter[str] = Counter()

    def log(self, event: dict[str, Any]) -> None:
        """Writes one event, or counts it if one of the same key was written within the last second."""
        key = (event["kind"], event.get("robot", ""), event.get("service", ""))
        now = self._clock()
        with self._lock:
            self._counts[event["kind"]] += 1
            window = self._windows.get(key)
            if window is not None and now - window.opened < _RATE_WINDOW_SECONDS:
                window.newest, window.left_out = event, window.left_out + 1
                # Only the first event left out starts the timer; the timer writes the newest one.
                if window.left_out == 1:
                    self._later(_RATE_WINDOW_SECONDS - (now - window.opened), lambda: self._close(key, window))
                return
            self._open(key, now)
        # The window is over, but its timer has not run yet. Add the events that it would have reported to this line.
        missed = 0 if window is None else window.left_out
        # Written outside the lock: standard error may be a pipe that blocks.
        self._write(_line({**event, "repeated": missed + 1} if missed else event))

    def counts(self) -> dict[str, int]:
        """Returns the number of events by kind, written or not."""
        with self._lock:
            return dict(self._counts)

    def reset_rate_limits(self) -> None:
        """Writes the next event of each kind immediately; drops the events that are held back."""
        with self._lock:
            self._windows.clear()

    def _open(self, key: _Key, now: float) -> None:
        self._windows[key] = _Window(now)
        self._windows.move_to_end(key)
        while len(self._windows) > _MOST_WINDOWS:
            self._windows.popitem(last=False)

    def _close(self, key: _Key, window: _Window) -> None:
        """Writes the events left out in a window, unless ``log`` has done so already."""
        with self._lock:
            # Another event may have opened a new window before this timer ran.
            if self._windows.get(key) is not window or window.newest is None:
                return
            event = window.newest if window.left_out == 1 else {**window.newest, "repeated": window.left_out}
            self._open(key, self._clock())
        self._write(_line(event))


def _line(event: dict[str, Any]) -> str:
    short = {name: _short(value) for name, value in event.items()}
    if not _as_text():
        return json.dumps(short) + "\n"
    stamp = time.strftime("%H:%M:%S", time.localtime(short.pop("time")))
    about = ", ".join(f"{name} {_on_one_line(value)}" for name, value in short.items() if name not in _HEAD)
    tail = f" ({about})" if about else ""
    return f"{stamp} {short['level']} {short['kind']}: {_on_one_line(short['sentence'])}{tail}\n"


def _as_text() -> bool:
    """Whether to write text: as ``SAFEDPA_LOG`` says, by default on a terminal only."""
    wanted = os.environ.get("SAFEDPA_LOG", "")
    if wanted:
        return wanted == "text"
    try:
        return sys.stderr.isatty()
    except (ValueError, AttributeError):  # closed, or never there
        return False


_HEAD = ("level", "kind", "sentence")


def _short(value: Any) -> Any:
    if type(value) in (bool, int, float) or value is None:
        return value
    text = str(value)
    return text if len(text) <= _LONGEST_TEXT else text[: _LONGEST_TEXT - 3] + "..."


def _on_one_line(value: Any) -> str:
    """Escapes control characters."""
    # An attacker could put line breaks or terminal escape sequences into a name and fake other log lines.
    return printable(str(value))


EVENT_LOG = EventLog()
"""The event log of this process."""


def log_event(
    kind: str, sentence: str, *, level: str = "info", robot: str = "", tick: int = -1, service: str = "", **more: Any
) -> None:
    """Logs one event; never raises.

    ``kind`` is one of ``KINDS``, such as ``bus.denied``; ``level`` is ``info``, ``warning`` or ``error``. ``robot``,
    ``tick`` and ``service`` are left out of the line if they are not given; ``more`` has further fields.
    """
    event: dict[str, Any] = {"time": round(time.time(), 3), "level": level, "kind": kind, "sentence": sentence}
    event |= {name: value for name, value in (("robot", robot), ("service", service)) if value}
    event |= {"tick": tick} if tick >= 0 else {}
    EVENT_LOG.log(event | more)
