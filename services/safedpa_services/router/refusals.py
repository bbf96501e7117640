"""What the router refused, read out of Zenoh's own log, since Zenoh tells neither the sender nor anybody else.

Zenoh's interceptors write, on the thread that handles a message, first the decision on its key (``... is unauthorized
to Put (ingress) on KEY``) and then, if the message goes no further, ``Msg intercepted!``. A decision alone says
nothing: many are made and kept in advance. A message that is allowed and yet goes no further was larger than its topic
allows. What is withheld on the way out is no attempt of anybody, and is not told.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import re
import threading
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

from safedpa.bus.logging import log_event

__all__ = ["LOG_DIRECTIVES", "LogFile", "Refusals", "capture_zenoh_log"]

LOG_DIRECTIVES = ",".join(
    (
        "warn",
        "zenoh::net::routing::interceptor=trace",
        "zenoh_link_tls=debug",
        "zenoh_transport::unicast::establishment=debug",
    )
)
"""What Zenoh must write for this; the decisions are at its finest level."""

_LINE = re.compile(r"\S+\s+(TRACE|DEBUG|INFO|WARN|ERROR)\s+(?:\S+ )?ThreadId\((\d+)\) (\S+?): (.*)")
_DECISION = re.compile(r"(?:Using cached result: )?(\w+) (?:on (\S+) )?is (un)?authorized to (.+) \((\w+)\) on (\S+)")
_COMMON_NAME = re.compile(r"CertCommonName\(([^)]*)\)")
_ACCEPTED = re.compile(r"Accepted TLS connection on \S+: (\S+)\. Common Name: (.*)\.$")
_HINT = " Hint: increase the system open file limit."
_ACCESS = "zenoh::net::routing::interceptor::access_control"
_INTERCEPTED = "zenoh::net::routing::interceptor"
_MOST_NAMES = 4096


@dataclass(frozen=True)
class _Decision:
    session: str
    act: str
    flow: str
    key: str
    allowed: bool


_UNKNOWN = _Decision("", "", "ingress", "", allowed=False)
"""Of a message that went no further while the line about its key was lost."""


class Refusals:
    """Takes Zenoh's log line by line, and tells and counts what was refused."""

    def __init__(self) -> None:
        self.name_of: Callable[[str], str] = lambda session: ""
        """Gives the certificate's common name of a session by its Zenoh id, empty when it is not known."""
        self._names: OrderedDict[str, str] = OrderedDict()
        self._last: dict[str, _Decision] = {}
        self.counts: Counter[str] = Counter()
        """By kind of event."""
        self.newest = ""
        """The last refusal in words."""

    @property
    def total(self) -> int:
        """Everything refused so far."""
        return sum(self.counts.values())

    def hear(self, line: str) -> None:
        """Takes one line of Zenoh's log."""
        found = _LINE.match(line)
        if found is None:
            return
        level, thread, target, text = found.groups()
        if target == _ACCESS:
            self._hear_decision(thread, text)
        elif target == _INTERCEPTED:
            self._hear_end(thread, text)
        elif target.startswith("zenoh_link_tls") or "establishment::accept" in target:
            self._hear_handshake(level, text)
        elif level in ("WARN", "ERROR"):
            log_event("bus.zenoh", text, level=level.lower().replace("warn", "warning"), service="router")

    def _hear_decision(self, thread: str, text: str) -> None:
        found = _DECISION.match(text)
        if found is None:
            return
        session, subject, no, act, flow, key = found.groups()
        name = _COMMON_NAME.search(subject or "")
        if name is not None:
            self._names[session] = name[1]
            while len(self._names) > _MOST_NAMES:
                self._names.popitem(last=False)
        self._last[thread] = _Decision(session, act, flow, key, allowed=no is None)

    def _hear_end(self, thread: str, text: str) -> None:
        if text != "Msg intercepted!":
            return
        decision = self._last.pop(thread, _UNKNOWN)
        if decision.flow != "ingress":
            return
        name = self._names.get(decision.session) or self.name_of(decision.session) or "somebody"
        if decision is _UNKNOWN:
            sentence = "a message was held back: it came too often, or Zenoh's log had no room to say whose it was"
            self._refused("bus.held_back", sentence, name, decision)
        elif decision.allowed and decision.act == "Put":
            self._refused(
                "bus.too_large", f"{name} sent more bytes under '{decision.key}' than its topic allows", name, decision
            )
        else:
            self._refused("bus.denied", f"{name} may not {decision.act.lower()} under '{decision.key}'", name, decision)

    def _refused(self, kind: str, sentence: str, name: str, decision: _Decision) -> None:
        self.counts[kind] += 1
        self.newest = sentence
        parts = decision.key.split("/")
        robot = parts[2] if len(parts) > 2 else ""
        log_event(
            kind,
            sentence,
            level="warning",
            robot=robot,
            service=name,
            act=decision.act.lower(),
            key=decision.key,
            session=decision.session,
        )

    def _hear_handshake(self, level: str, text: str) -> None:
        accepted = _ACCEPTED.match(text)
        if accepted is not None:
            log_event("bus.joined", f"{accepted[2]} connects from {accepted[1]}", service=accepted[2])
        elif level in ("WARN", "ERROR") or text.startswith("Decode error"):
            self.counts["bus.handshake_refused"] += 1
            self.newest = f"a connection was refused: {text.removesuffix(_HINT).rstrip('.')}"
            log_event("bus.handshake_refused", self.newest, level="warning")


_GULP_BYTES = 1 << 20
_MOST_UNREAD = 8 << 20
"""bytes; what is older is passed over."""
_LONGEST_LINE = 1 << 16
_PAUSE_SECONDS = 0.02
_REPORTED_SECONDS = 1.0
_NICE = 10
_PUNCH_HOLE, _KEEP_SIZE = 2, 1


def capture_zenoh_log(directives: str, hear: Callable[[str], None]) -> None:
    """From now on, for the whole process, hands every line of Zenoh's log to ``hear``, on a thread of its own.

    Must be called before the first session is opened; takes standard output for itself. Between them lies a file in
    memory, and no pipe: anyone who writes to a full pipe waits for its reader or is told of an error, and of each error
    Zenoh would tell standard error, again waiting, while messages of the loop stand behind it. What a flood writes
    faster than it is read is passed over, and that is told once a second. The messages are refused all the same.
    """
    import zenoh

    file = LogFile()
    os.dup2(file.descriptor, 1)
    os.environ.update(RUST_LOG=directives, NO_COLOR="1")
    zenoh.init_log_from_env_or(directives)
    threading.Thread(target=_read, args=(file, hear), daemon=True).start()


@final
class LogFile:
    """A file in memory that grows at one end and is given back at the other as it is read."""

    def __init__(self, most_unread: int = _MOST_UNREAD) -> None:
        self.descriptor = os.memfd_create("zenoh-log", os.MFD_CLOEXEC)
        fcntl.fcntl(self.descriptor, fcntl.F_SETFL, os.O_APPEND)
        self._most_unread = most_unread
        self._read, self._rest = 0, b""
        self.passed_over = 0
        """bytes that no one read."""

    def lines(self) -> list[str]:
        """Whole lines that came since the last call, a gulp of them at most; never waits."""
        behind = os.fstat(self.descriptor).st_size - self._read
        if behind > self._most_unread:
            self._read, self._rest = self._read + behind, b""
            self.passed_over += behind
        gulp = os.pread(self.descriptor, _GULP_BYTES, self._read)
        self._read += len(gulp)
        if gulp or behind > self._most_unread:
            self._give_back()
        *lines, rest = (self._rest + gulp).split(b"\n")
        self._rest = rest[-_LONGEST_LINE:]
        return [line.decode(errors="replace").rstrip() for line in lines]

    def _give_back(self) -> None:
        size = ctypes.c_int64(self._read)
        ctypes.CDLL(None).fallocate(self.descriptor, _PUNCH_HOLE | _KEEP_SIZE, ctypes.c_int64(0), size)


def _read(file: LogFile, hear: Callable[[str], None]) -> None:
    """In gulps, behind everything else: at every line a reader would be woken next to the messages' own way."""
    thread = threading.get_native_id()
    with contextlib.suppress(OSError):
        os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))  # --realtime is for the messages
        os.setpriority(os.PRIO_PROCESS, thread, _NICE)
    pause, reported, looks = threading.Event(), 0, 0
    while True:
        for line in file.lines():
            hear(line)
        looks += 1
        if file.passed_over > reported and looks * _PAUSE_SECONDS >= _REPORTED_SECONDS:
            reported, looks = file.passed_over, 0
            log_event("bus.log_overrun", "more was refused than could be told", level="warning", service="router")
        pause.wait(_PAUSE_SECONDS)
