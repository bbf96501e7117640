"""Reports what the router refused, by parsing Zenoh's log: Zenoh reports refusals nowhere else.

For each message, Zenoh's interceptors log the decision on its key (``... is unauthorized to Put (ingress) on KEY``) and
then, if the message is dropped, ``Msg intercepted!``, on the same thread. A decision alone means nothing, because many
are computed and cached in advance. A message that is authorised but dropped was larger than its topic allows. Messages
dropped on egress are not reported: they are no attempt by a client.
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

LOG_DIRECTIVES = ",".join(
    (
        "warn",
        "zenoh::net::routing::interceptor=trace",
        "zenoh_link_tls=debug",
        "zenoh_transport::unicast::establishment=debug",
    )
)
"""Log filter for Zenoh; the decisions are logged at level trace only."""

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
"""Stands for a dropped message whose decision line was lost."""


class Refusals:
    """Parses Zenoh's log line by line; logs and counts refusals."""

    def __init__(self) -> None:
        self.name_of: Callable[[str], str] = lambda session: ""
        """Returns the common name of a session's certificate by its Zenoh id; empty if unknown."""
        self._names: OrderedDict[str, str] = OrderedDict()
        self._last: dict[str, _Decision] = {}
        self.counts: Counter[str] = Counter()
        """Number of refusals by kind of event."""
        self.newest = ""
        """Sentence about the last refusal."""

    @property
    def total(self) -> int:
        """Number of refusals so far."""
        return sum(self.counts.values())

    def hear(self, line: str) -> None:
        """Parses one line of Zenoh's log."""
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
        name = self._names.get(decision.session) or self.name_of(decision.session) or "an unknown client"
        if decision is _UNKNOWN:
            sentence = "a message of an unknown client was dropped: it exceeded its rate, or its log line was lost"
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


_CHUNK_BYTES = 1 << 20
_MOST_UNREAD = 8 << 20
"""bytes; older log lines are skipped."""
_LONGEST_LINE = 1 << 16
_PAUSE_SECONDS = 0.02
_REPORTED_SECONDS = 1.0
_NICE = 10
_PUNCH_HOLE, _KEEP_SIZE = 2, 1


def capture_zenoh_log(directives: str, hear: Callable[[str], None]) -> None:
    """Passes every line of Zenoh's log to ``hear`` from now on, on a separate thread.

    Call it before the first session is opened. It redirects standard output, where Zenoh writes its log, to a file in
    memory. A pipe would not do: a full pipe blocks Zenoh or returns an error, which Zenoh reports on standard error,
    blocking again, while messages of the control loop wait. If a flood of refusals is logged faster than it is read,
    lines are skipped, which is logged once a second; the messages are refused nevertheless.
    """
    import zenoh

    file = LogFile()
    os.dup2(file.descriptor, 1)
    os.environ.update(RUST_LOG=directives, NO_COLOR="1")
    zenoh.init_log_from_env_or(directives)
    threading.Thread(target=_read, args=(file, hear), daemon=True).start()


@final
class LogFile:
    """A file in memory that is appended to, and whose memory is released as it is read."""

    def __init__(self, most_unread: int = _MOST_UNREAD) -> None:
        self.descriptor = os.memfd_create("zenoh-log", os.MFD_CLOEXEC)
        fcntl.fcntl(self.descriptor, fcntl.F_SETFL, os.O_APPEND)
        self._most_unread = most_unread
        self._read, self._rest = 0, b""
        self.skipped = 0
        """Number of skipped bytes."""

    def lines(self) -> list[str]:
        """Returns the complete lines since the last call, at most 1 MiB of them; never blocks."""
        behind = os.fstat(self.descriptor).st_size - self._read
        if behind > self._most_unread:
            self._read, self._rest = self._read + behind, b""
            self.skipped += behind
        chunk = os.pread(self.descriptor, _CHUNK_BYTES, self._read)
        self._read += len(chunk)
        if chunk or behind > self._most_unread:
            size = ctypes.c_int64(self._read)
            ctypes.CDLL(None).fallocate(self.descriptor, _PUNCH_HOLE | _KEEP_SIZE, ctypes.c_int64(0), size)
        *lines, rest = (self._rest + chunk).split(b"\n")
        self._rest = rest[-_LONGEST_LINE:]
        return [line.decode(errors="replace").rstrip() for line in lines]


def _read(file: LogFile, hear: Callable[[str], None]) -> None:
    """Reads the log periodically at low priority: waking up for each line would delay the messages."""
    thread = threading.get_native_id()
    with contextlib.suppress(OSError):
        os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))  # --realtime applies to the messages only
        os.setpriority(os.PRIO_PROCESS, thread, _NICE)
    pause, logged, looks = threading.Event(), 0, 0
    while True:
        for line in file.lines():
            hear(line)
        looks += 1
        if file.skipped > logged and looks * _PAUSE_SECONDS >= _REPORTED_SECONDS:
            logged, looks = file.skipped, 0
            log_event(
                "bus.log_overrun", "more messages were refused than could be logged", level="warning", service="router"
            )
        pause.wait(_PAUSE_SECONDS)
