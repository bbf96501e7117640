"""The one catalogue of events: every ``kind`` that a process of this project writes to its log, with what it means.

What happened, one structured line each on standard error, for people and for programs that collect logs.

A line is a JSON object: ``time`` [s since 1970], ``level``, ``kind`` (dotted, stable: what programs look for),
``sentence``, and where they apply ``robot``, ``tick``, ``service`` and whatever else the event carries. On a
terminal, or with ``SAFEDPA_LOG=text``, it is one readable line instead.

A flood costs one line a second: of events of the same kind, robot and service within a second only the first is
written, and the line that closes the second carries ``repeated``, the number of those that were left out, next to the
newest of them.
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

__all__ = [
    "EVENT_LOG",
    "KINDS",
    "DelayedCaller",
    "EventLog",
    "counted_events",
    "log_event",
]

KINDS = MappingProxyType(
    {
        "process.started": "A process joined the bus.",
        "process.ended": "A process ends in order; says after which signal.",
        "child.restarted": "The supervisor starts a process again that had died, or that it killed since it hung.",
        "robot.met": "A service hears a robot for the first time.",
        "robot.began_anew": "A robot speaks with a new epoch: it was started again.",
        "robot.forgotten": "A robot was silent for so long that a service forgets it.",
        "robot.second_refused": "A second robot speaks under a name in use; nothing of it is taken.",
        "message.refused": "What arrived was no message, or came out of order; says why.",
        "filter.fallback_entered": "The safety filter could not decide and brakes; says why.",
        "filter.fallback_left": "The safety filter decides again; says for how many ticks it had not.",
        "filter.disabled": "The safety filter hands nominal actions on unchecked, since it is switched off.",
        "filter.stopped": "A robot is stopped by an order or by the filter's end.",
        "filter.released": "A robot that was stopped may drive again.",
        "order.taken": "Someone ordered robots to stop or to go, or switched a source or a zone.",
        "order.refused": "An order was refused; says why.",
        "order.kept": "A filter, or perception, that was started found an order that is still in force.",
        "order.lost": "Perception cannot read the orders that it kept: no source counts until one is switched on.",
        "perception.ignores": "What is seen in the zones named is not told of a robot: by the file, or an order.",
        "perception.source_off": "Sources of a robot are not listened to: by the file, or an order; says which.",
        "perception.source_unknown": "The file of perception names sources that the robot does not have.",
        "perception.switched": "From the tick named on other sources or zones of a robot count; says which.",
        "model.offered": "The diagnosis offers the services a new model of a robot.",
        "model.decided": "All services are ready: from the tick named on the new model is in force.",
        "model.dropped": "An offered model is not taken; says why.",
        "model.ready": "A service loaded the offered model and checked it.",
        "model.taken": "A service uses the new model.",
        "model.refused": "A service cannot use the offered model; says why.",
        "finding.changed": "The diagnosis comes to another stage: raised, searching, candidates, nothing, watching.",
        "recorder.failed": "The recording broke off; says why.",
        "recorder.resumed": "The recording goes on in another file, since the disk has room again.",
        "recorder.lost": "The recorder could not keep up; says how many messages are missing.",
        "router.open": "The router accepts connections.",
        "router.stands": "The router's own work came to a stand; it ends, so that it is restarted.",
        "bus.plain_text": "The bus can be reached from other machines without certificates.",
        "bus.unclosed": "A process ends, and its session with the bus did not close in time; its links end with it.",
        "bus.key_exposed": "A private key can be read by every user of the machine.",
        "bus.astray": "What came under another key than it was sent under, after a lost link, was passed over.",
        "bus.twice": "Two connect with one certificate; one of them may not be who it says.",
        "bus.joined": "Someone connects to the router with a certificate.",
        "bus.handshake_refused": "Someone was refused at the router's door.",
        "bus.denied": "Someone tried what its role may not; the router let nothing through.",
        "bus.too_large": "Someone sent more bytes than the topic allows; the router let nothing through.",
        "bus.held_back": "Someone sends more often than any robot ticks; the router lets a part through.",
        "bus.strangers_cut_off": "Connections were ended that did not say in time who they are.",
        "bus.revoked": "Links of certificates that are good for nothing any more were ended.",
        "page.refused": "A page was asked by another page, under another name, without its token, or for too much.",
        "page.wrong_password": "Someone gave a wrong password to a page.",
        "bus.log_overrun": "More was refused than could be told one by one.",
        "bus.zenoh": "A warning of the network library.",
    }
)
"""By kind: what it means. Kinds are stable: what watches logs may rely on them."""


_LEAST_SECONDS = 1.0
_MOST_WINDOWS = 512
"""Kinds times robots times services whose rate is watched; names may come from an attacker, memory is ours."""
_LONGEST_TEXT = 400
"""Characters of one value."""

Later = Callable[[float, Callable[[], None]], object]


_Key = tuple[str, str, str]
"""Kind, robot, service."""


@dataclass
class _Window:
    """A second that began with a line."""

    opened: float
    """s, by the clock; when the last line was written."""
    left_out: int = 0
    newest: dict[str, Any] | None = None


def _to_standard_error(line: str) -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):  # closed, broken, or never there
        sys.stderr.write(line)
        sys.stderr.flush()


@final
class DelayedCaller:
    """Calls what it is given at its moment, all of it in one thread, which ends when nothing is left.

    A thread for each would cost a service that is late already: of a hundred robots whose verdicts change, two hundred
    threads a second.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        """By moment [s, monotonic clock], and in the order in which they were given."""
        self._number = count()
        self._thread: threading.Thread | None = None

    def __call__(self, seconds: float, work: Callable[[], None]) -> None:
        """Has ``work`` called after ``seconds``, at once where that is below 0."""
        with self._changed:
            heapq.heappush(self._due, (time.monotonic() + seconds, next(self._number), work))
            if self._thread is None or not self._thread.is_alive():  # not alive: of the process that this is a fork of
                self._thread = threading.Thread(target=self._run, name="safedpa-alarm", daemon=True)
                self._thread.start()
            elif self._due[0][2] is work:
                self._changed.notify()

    def _run(self) -> None:
        while (work := self._next()) is not None:
            try:
                work()
            except Exception:  # noqa: BLE001 - it is told as a thread's own would be, and the others are done all the same
                sys.excepthook(*sys.exc_info())

    def _next(self) -> Callable[[], None] | None:
        """The next work, once it is due; None where nothing is left: the thread ends then, and the next is another."""
        with self._changed:
            while self._due:
                left = self._due[0][0] - time.monotonic()
                if left <= 0.0:
                    return heapq.heappop(self._due)[2]
                self._changed.wait(left)
            self._thread = None
            return None


class EventLog:
    """Writes events to ``write``; ``clock`` measures the second, ``later`` closes it."""

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
        """Writes one event, or keeps it back and counts it where the like of it was written within the second."""
        key = (event["kind"], event.get("robot", ""), event.get("service", ""))
        now = self._clock()
        with self._lock:
            self._counts[event["kind"]] += 1
            window = self._windows.get(key)
            if window is not None and now - window.opened < _LEAST_SECONDS:
                window.newest, window.left_out = event, window.left_out + 1
                if window.left_out == 1:
                    self._later(_LEAST_SECONDS - (now - window.opened), lambda: self._close(key, window))
                return
            self._open(key, now)
        missed = 0 if window is None else window.left_out  # the timer is late
        self._write(_line({**event, "repeated": missed + 1} if missed else event))

    def counts(self) -> dict[str, int]:
        """How many events there were of each kind, written or not."""
        with self._lock:
            return dict(self._counts)

    def reset_rate_limits(self) -> None:
        """Writes the next event of each kind at once; events that are being held back are dropped."""
        with self._lock:
            self._windows.clear()

    def _open(self, key: _Key, now: float) -> None:
        self._windows[key] = _Window(now)
        self._windows.move_to_end(key)
        while len(self._windows) > _MOST_WINDOWS:
            self._windows.popitem(last=False)

    def _close(self, key: _Key, window: _Window) -> None:
        """Writes what was left out of the second that is over, unless that was done already."""
        with self._lock:
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
    """As ``SAFEDPA_LOG`` says; without a word text where a person looks, JSON where a program reads."""
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
    """Readable and on one line whatever an attacker put into a name."""
    return printable(str(value))


EVENT_LOG = EventLog()
"""Of this process."""


def log_event(
    kind: str, sentence: str, *, level: str = "info", robot: str = "", tick: int = -1, service: str = "", **more: Any
) -> None:
    """Writes one line about something that happened; never raises.

    ``kind`` is dotted and stable, such as ``bus.denied``; ``level`` is ``info``, ``warning`` or ``error``; ``robot``,
    ``tick`` and ``service`` are left out of the line where they are not given; ``more`` is what else belongs to it.
    """
    event: dict[str, Any] = {"time": round(time.time(), 3), "level": level, "kind": kind, "sentence": sentence}
    event |= {name: value for name, value in (("robot", robot), ("service", service)) if value}
    event |= {"tick": tick} if tick >= 0 else {}
    EVENT_LOG.log(event | more)


def counted_events() -> dict[str, int]:
    """How many events of each kind this process had, for status and metrics."""
    return EVENT_LOG.counts()
