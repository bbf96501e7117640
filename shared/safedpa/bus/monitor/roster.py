"""Who should be on the bus, as an observer knows it from the rosters of supervisors and from what it hears itself.

A member that is silent is missing until it returns or a person dismisses it, however long that takes. Its return keeps
an ``Incident``. A supervisor is itself a member: while it is silent, nothing restarts a process that ends.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Final, final

from safedpa.bus.messages.messages import RosterEntry, RosterMessage
from safedpa.bus.messages.topics import LONGEST_NAME

SILENT_SECONDS: Final = 1.5
"""Silence [s] after which a member is missing: services send four heartbeats a second, the recorder and a supervisor
two."""
SUPERVISOR: Final = "supervisor"
# Members and incidents are bounded, because any client of a plain-text bus may send a roster.
_MOST_MEMBERS: Final = 4096
_MOST_INCIDENTS: Final = 64


@dataclass
class Member:
    """A robot, service or supervisor that should be there; times are [s] by the observer's clock."""

    kind: str
    """``robot``, ``service`` or ``supervisor``."""
    name: str
    source: str
    """The supervisor's run that lists it."""
    since: float
    """When it was listed first."""
    heard_at: float | None = None
    """When this observer heard it last; None: never."""
    reported_at: float | None = None
    """When the supervisor heard it last, by its roster; None: never."""
    restarts: int = 0
    cause: str = ""
    given_up: bool = False
    dismissed_by: str = ""
    dismissed_at: float = 0.0

    @property
    def label(self) -> str:
        """Its name for people: a supervisor's own name is the random identifier of its run."""
        return SUPERVISOR if self.kind == SUPERVISOR else self.name

    def last_at(self) -> float | None:
        """Returns when it was heard last by anyone; None: never."""
        known = [at for at in (self.heard_at, self.reported_at) if at is not None]
        return max(known) if known else None

    def silent_for(self, now: float) -> float:
        """Returns the time in s for which this observer or, before it heard the member, the supervisor misses it."""
        if self.heard_at is not None:
            return max(0.0, now - self.heard_at)
        return max(0.0, now - (self.since if self.reported_at is None else min(self.since, self.reported_at)))

    def is_missing(self, now: float, limit: float = SILENT_SECONDS) -> bool:
        """Whether it is silent for more than ``limit`` [s] and was not dismissed."""
        return not self.dismissed_by and self.silent_for(now) > limit

    def sentence(self, now: float) -> str:
        """Returns how long it has been missing, and what is known of the cause."""
        last = self.last_at()
        text = "not heard yet" if last is None else f"missing, heard last {now - last:.0f} s ago"
        text += f"; {self.cause}" if self.cause else ""
        return f"{text}; it is not restarted any more" if self.given_up else text


@dataclass(frozen=True)
class Incident:
    """A silence that is over, or a restart."""

    kind: str
    name: str
    ended: float
    """When it was over [s by the observer's clock]."""
    seconds: float
    """Length of the silence; 0 for a restart without one."""
    sentence: str


@final
@dataclass
class Roster:
    """The members of all supervisors that an observer heard; empty without a supervisor."""

    members: dict[tuple[str, str], Member] = field(default_factory=dict)
    incidents: deque[Incident] = field(default_factory=lambda: deque(maxlen=_MOST_INCIDENTS))
    """The newest incidents, oldest first."""
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Incidents of each member since the observer began."""

    def hear(self, message: RosterMessage, at: float) -> None:
        """Handles a roster, the end of one, or a dismissal, that arrived at ``at`` [s]."""
        if message.dismisses:
            self.dismiss(message.dismisses, message.who, at)
            return
        if message.ended:
            self.members = {key: known for key, known in self.members.items() if known.source != message.source}
            return
        own = (SUPERVISOR, message.source)
        self._list(own, message.source, at)
        self.note(*own, at)
        listed = {own}
        for entry in message.entries:
            key = (entry.kind, entry.name)
            if entry.kind in ("robot", "service") and 0 < len(entry.name) <= LONGEST_NAME and entry.name.isprintable():
                listed.add(key)
                self._update(key, entry, message.source, at)
        self.members = {
            key: known
            for key, known in self.members.items()
            if key in listed or (known.source != message.source and not self._is_replaced(known, listed, at))
        }

    def note(self, kind: str, name: str, at: float, limit: float = SILENT_SECONDS) -> None:
        """Notes that something was heard of a member at ``at`` [s]; a return after a silence becomes an incident."""
        known = self.members.get((kind, name))
        if known is None or (known.heard_at is not None and at <= known.heard_at):
            return
        silence = 0.0 if known.heard_at is None else at - known.heard_at
        if silence > limit:
            who = f", dismissed by {known.dismissed_by}" if known.dismissed_by else ""
            self._add(known, at, silence, f"was missing for {silence:.0f} s{who}")
        known.heard_at = at
        if known.dismissed_by and at > known.dismissed_at:
            known.dismissed_by = ""

    def dismiss(self, names: tuple[str, ...], who: str, at: float) -> None:
        """Notes that these members are not expected any more until they return."""
        for known in self.members.values():
            if known.label in names and known.silent_for(at) > SILENT_SECONDS:
                known.dismissed_by, known.dismissed_at = who or "a person", at

    def excuse(self, now: float) -> None:
        """Counts the time until ``now`` [s] against no member: this observer itself did not run meanwhile."""
        for known in self.members.values():
            if known.heard_at is not None and not known.is_missing(known.heard_at):
                known.heard_at = now

    def missing(self, now: float) -> list[Member]:
        """Returns who is missing, supervisors first."""
        found = [known for known in self.members.values() if known.is_missing(now)]
        return sorted(found, key=lambda known: (known.kind != SUPERVISOR, known.kind, known.name))

    def is_dismissed(self, kind: str, name: str) -> bool:
        """Whether a person declared that a member is not expected any more."""
        known = self.members.get((kind, name))
        return known is not None and bool(known.dismissed_by)

    def expected(self, kind: str) -> dict[str, Member]:
        """Returns the members of a kind by name."""
        return {name: known for (own, name), known in self.members.items() if own == kind}

    def _list(self, key: tuple[str, str], source: str, at: float) -> Member | None:
        known = self.members.get(key)
        if known is None and len(self.members) < _MOST_MEMBERS:
            known = self.members[key] = Member(*key, source, at)
        elif known is not None and known.source != source:
            known.source, known.restarts = source, 0
        return known

    def _update(self, key: tuple[str, str], entry: RosterEntry, source: str, at: float) -> None:
        known = self._list(key, source, at)
        if known is None:
            return
        if entry.restarts > known.restarts:
            if known.restarts or known.since < at:  # not those before this observer began
                self._add(known, at, 0.0, f"restarted: {entry.cause}" if entry.cause else "restarted")
            known.restarts = entry.restarts
        known.cause, known.given_up = entry.cause, entry.given_up
        if entry.silent_for >= 0.0:
            known.reported_at = at - entry.silent_for
        if entry.dismissed_by and not known.dismissed_by and known.silent_for(at) > SILENT_SECONDS:
            known.dismissed_by, known.dismissed_at = entry.dismissed_by, at

    def _is_replaced(self, member: Member, listed: set[tuple[str, str]], at: float) -> bool:
        """Whether a silent supervisor's robots are all listed by the run that sent ``listed``."""
        if member.kind != SUPERVISOR or member.silent_for(at) <= SILENT_SECONDS:
            return False
        robots = {key for key, known in self.members.items() if known.source == member.source and key[0] == "robot"}
        return not robots and any(kind == "robot" for kind, _ in listed)

    def _add(self, member: Member, at: float, seconds: float, sentence: str) -> None:
        self.incidents.append(Incident(member.kind, member.name, at, seconds, sentence))
        self.counts[member.kind, member.name] += 1
