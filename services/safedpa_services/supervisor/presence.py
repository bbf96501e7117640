"""Publishes the roster of a run, and reports who falls silent and who returns."""

from __future__ import annotations

import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from safedpa.bus import NO_ROBOT, ROSTER, Bus, ReceivedMessage, RosterEntry, RosterMessage
from safedpa.bus.messages.messages import header
from safedpa.bus.monitor import Member, Roster
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.run_monitor import RunMonitor

_INTERVAL_SECONDS = 0.5
"""An observer that joins learns within this time who should be there."""
_STALL_SECONDS = 1.0
"""A turn that is later than this says nothing about the others: the supervisor itself was stopped or starved."""


@dataclass
class RunPresence:
    """Who should be on the bus in this run; call ``turn`` often, ``begin`` once the robots drive, ``end`` at the end.

    Silences are reported once they begin and once they are over, through ``RunMonitor.notices`` of the first robot,
    and only after ``begin``: before, every process is still starting.
    """

    bus: Bus
    watches: Sequence[RunMonitor]
    services: Sequence[Child]
    robots: Mapping[str, Child] = field(default_factory=dict)
    """The robots' processes by the robot's name, of those that run here."""
    roster: Roster = field(default_factory=Roster)
    _source: str = field(default_factory=lambda: uuid.uuid4().hex[:12])
    _next: float = 0.0
    _missing: dict[tuple[str, str], float] = field(default_factory=dict)
    """By member: since when it has been reported as missing."""
    _has_begun: bool = False

    def __post_init__(self) -> None:
        self._dismissals = self.bus.inbox((ROSTER,), NO_ROBOT, keep_all=True)

    def begin(self) -> None:
        """Begins to report silences."""
        self._has_begun = True

    def turn(self) -> None:
        """Publishes the roster if it is due, and reports changes."""
        now = time.monotonic()
        if now < self._next:
            return
        if now - self._next > _STALL_SECONDS and self._next > 0.0:
            self.roster.excuse(now)
            self._report(f"the supervisor itself did not run for {now - self._next:.0f} s")
        self._next = now + _INTERVAL_SECONDS
        message = RosterMessage(**header(), source=self._source, entries=tuple(self._entries(now)))
        self.roster.hear(message, now)
        for (kind, name), heard in self._heard().items():
            if heard is not None:
                self.roster.note(kind, name, heard)
        for item in self._dismissals.take(0.0):
            if isinstance(item, ReceivedMessage) and isinstance(item.message, RosterMessage) and item.message.dismisses:
                self.roster.dismiss(item.message.dismisses, item.message.who, now)
                self._report(f"{', '.join(item.message.dismisses)}: dismissed by {item.message.who}")
        entries = tuple(replace(entry, dismissed_by=self._member(entry).dismissed_by) for entry in message.entries)
        self.bus.publish(ROSTER, NO_ROBOT, replace(message, entries=entries))
        if self._has_begun:
            self._report_changes(now)

    def end(self) -> None:
        """Declares that the run ends in order: nothing of it is expected any more."""
        self.bus.publish(ROSTER, NO_ROBOT, RosterMessage(**header(), source=self._source, ended=True))
        self._next = float("inf")

    def incidents(self) -> list[dict[str, Any]]:
        """Returns the silences of the run: kind, name, seconds, and whether the member returned."""
        over = [{"kind": each.kind, "name": each.name, "seconds": round(each.seconds, 1), "returned": True}
                for each in self.roster.incidents if each.seconds > 0.0]  # fmt: skip
        still = [{"kind": kind, "name": name, "seconds": round(self._last - since, 1), "returned": False}
                 for (kind, name), since in self._missing.items()]  # fmt: skip
        return [*over, *still]

    @property
    def _last(self) -> float:
        return time.monotonic()

    def _heard(self) -> dict[tuple[str, str], float | None]:
        """Returns when each member was heard last [s]; None: never."""
        found: dict[tuple[str, str], float | None] = {}
        for watch in self.watches:
            found["robot", watch.robot] = watch.state_at
        for child in self.services:
            if child.heartbeat:
                found["service", child.name] = max(
                    (watch.health[child.name][1] for watch in self.watches if child.name in watch.health), default=None
                )
        return found

    def _entries(self, now: float) -> list[RosterEntry]:
        services = {child.name: child for child in self.services}
        entries = []
        for (kind, name), heard in self._heard().items():
            child = (services if kind == "service" else self.robots).get(name)
            entry = RosterEntry(kind=kind, name=name, silent_for=-1.0 if heard is None else max(0.0, now - heard))
            if child is not None:
                entry = replace(entry, restarts=child.restarts, cause=child.cause, given_up=child.given_up)
            entries.append(entry)
        return entries

    def _member(self, entry: RosterEntry) -> Member:
        return self.roster.members[entry.kind, entry.name]

    def _report_changes(self, now: float) -> None:
        missing = {(member.kind, member.name): member for member in self.roster.missing(now)}
        for key, member in missing.items():
            if key not in self._missing:
                self._missing[key] = now - member.silent_for(now)
                what = "; it brakes by itself, if it lives" if member.kind == "robot" else ""
                self._report(f"{member.label}: {member.sentence(now)}{what}")
        for key in list(self._missing):
            if key not in missing:
                since = self._missing.pop(key)
                member = self.roster.members[key]
                if not member.dismissed_by:
                    self._report(f"{member.label}: is back after {now - since:.0f} s")

    def _report(self, sentence: str) -> None:
        self.watches[0].notices.append(sentence)
