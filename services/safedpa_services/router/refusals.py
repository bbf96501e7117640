"""What the router refused, read out of Zenoh's own log, since Zenoh tells neither the sender nor anybody else.

Zenoh's interceptors write, on the thread that handles a message, first the decision on its key (``... is unauthorized
to X"""

from __future__ import annotations

import re
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from safedpa.bus.log import log_event

__all__ = ["LOG_DIRECTIVES", "Refusals"]

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
