"""What the router does besides routing: heartbeats, duplicate and revoked certificates, and a watchdog."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import final

from safedpa.bus import Bus
from safedpa.bus.logging import log_event
from safedpa.bus.security.access_control import ROLES, ROUTER
from safedpa.bus.service.lease import LeaseTable
from safedpa.errors import SafedpaError
from safedpa.limits import text_of_file
from safedpa_services.router.refusals import Refusals

_HEARTBEAT_SECONDS = 0.25
_LOOKS = 4
"""Consecutive looks after which a second session counts as a duplicate. A lost session disappears within the lease of
0.5 s."""

_OPENING_LOOKS = 8
"""Looks after the start in which all sessions count as equally old: clients retry every 0.4 s while there is no
router."""

_MOST_SESSIONS = 4096
"""Sessions that are remembered."""
Members = Callable[[], Iterable[tuple[str, str]]]
"""Returns (Zenoh id, common name) of every connected session."""
CutOff = Callable[[set[str]], int]
"""Closes the links of sessions with these Zenoh ids; returns their number."""


class DuplicateCertificates:
    """Finds certificates that two processes use at once: a stolen copy, or a service that was started twice.

    The first session stays; ``cut_off`` closes the links of later ones. If both connected right after the router's
    start, the copy cannot be determined: both stay, and the event is logged. A session that reconnects keeps its age,
    because a router that was suspended loses all sessions at once and they return in any order.

    Only roles that announce themselves are checked; operators and health checks may connect any number of times.
    ``standby`` names a role of which a second session may wait, without the lease to send.
    """

    def __init__(self, members: Members, cut_off: CutOff = lambda sessions: 0, standby: str = "") -> None:
        self._members, self._cut_off, self._standby = members, cut_off, standby
        self._looks: dict[str, int] = {}
        """By name: number of consecutive looks with two sessions."""
        self._since: dict[str, int] = {}
        """By session: number of the look that saw it first; ordered by the last time it was seen."""
        self._number = 0
        self._copies: set[str] = set()
        """Sessions that were cut off; they reconnect automatically."""

    def look(self) -> list[str]:
        """Returns names with duplicate sessions; each is logged as ``bus.duplicate_certificate``."""
        self._number += 1
        sessions: dict[str, set[str]] = {}
        for session, name in self._members():
            role = ROLES.get(name.partition(".")[0])
            if role is not None and role.lives:
                sessions.setdefault(name, set()).add(session)
        self._remember({session for found in sessions.values() for session in found})
        self._looks = {
            name: self._looks.get(name, 0) + 1 for name, found in sessions.items() if len(found) > self._most(name)
        }
        known = {name for name in self._looks if sessions[name] & self._copies}
        lasting = sorted(known | {name for name, looks in self._looks.items() if looks >= _LOOKS})
        for name in lasting:
            self._report(name, sessions[name])
        return lasting

    def _most(self, name: str) -> int:
        return 2 if name == self._standby else 1

    def _remember(self, alive: set[str]) -> None:
        began = 0 if self._number <= _OPENING_LOOKS else self._number
        self._since |= {session: self._since.pop(session, began) for session in alive}
        while len(self._since) > max(_MOST_SESSIONS, len(alive)):
            self._copies.discard(oldest := next(iter(self._since)))
            del self._since[oldest]

    def _report(self, name: str, sessions: set[str]) -> None:
        first = sorted(self._since[session] for session in sessions)[self._most(name) - 1]
        later = {session for session in sessions if self._since[session] > first}
        cut = self._cut_off(later) if later else 0
        self._copies |= later
        what = "the later one is cut off" if cut else "one of them is a copy"
        sentence = f"{len(sessions)} processes use the certificate of {name}: {what}"
        log_event("bus.duplicate_certificate", sentence, level="warning", service=name)


class RevocationList:
    """Closes the links of certificates that a file lists, one name per line; the file is read again when it changes."""

    def __init__(self, path: Path | None, members: Members, cut_off: CutOff) -> None:
        self._path, self._members, self._cut_off = path, members, cut_off
        self._read_at = -1
        self.names: frozenset[str] = frozenset()

    def look(self) -> int:
        """Closes the links of revoked certificates; returns their number."""
        if self._path is None:
            return 0
        self._read()
        sessions = {session for session, name in self._members() if name in self.names} if self.names else set()
        if not sessions:
            return 0
        cut = self._cut_off(sessions)
        log_event("bus.revoked", f"{cut} links of revoked certificates were closed", level="warning", service=ROUTER)
        return cut

    def _read(self) -> None:
        """Reads the file if it changed; if that fails, the previous list stays in force."""
        assert self._path is not None
        with contextlib.suppress(OSError, UnicodeDecodeError, SafedpaError):
            changed = self._path.stat().st_mtime_ns
            if changed != self._read_at:
                self.names = read_revocation_list(self._path)
                self._read_at = changed


def read_revocation_list(path: Path) -> frozenset[str]:
    """Returns the names in a file of revoked certificates; none if there is no file."""
    try:
        lines = text_of_file(path, "toml_bytes").splitlines()
    except FileNotFoundError:
        return frozenset()
    return frozenset(line.strip() for line in lines if line.strip() and not line.startswith("#"))


class Router:
    """Sends the router's heartbeats, with the number of refusals and the newest one, and grants the filters' lease."""

    def __init__(
        self,
        bus: Bus,
        refusals: Refusals,
        members: Members = tuple,
        cut_off: CutOff = lambda sessions: 0,
        revoked: Path | None = None,
        standby: str = "",
    ) -> None:
        self._bus, self._refusals = bus, refusals
        self._duplicates = DuplicateCertificates(members, cut_off, standby)
        bus.answer_leases(LeaseTable().ask)
        self._revoked = RevocationList(revoked, members, cut_off)
        self._twice: list[str] = []
        self._beats = 0

    def run(self, stopped: Callable[[], bool], watchdog: LoopWatchdog) -> None:
        """Sends heartbeats until ``stopped``; each also resets ``watchdog``."""
        pause = threading.Event()
        while not stopped():
            self.beat()
            watchdog.beat()
            pause.wait(_HEARTBEAT_SECONDS)
        watchdog.end()

    def beat(self) -> None:
        """Checks the sessions and sends one heartbeat."""
        self._beats += 1
        self._twice = self._duplicates.look()
        self._revoked.look()
        self._bus.report_health(
            ROUTER,
            state="ready",
            detail=f"twice: {', '.join(self._twice)}" if self._twice else self._refusals.newest,
            steps=self._beats,
            refused=self._refusals.total,
        )


_STALL_LOOK_SECONDS = 0.25
_STALL_LOOKS = 20
"""Consecutive looks without a beat. Counted instead of timed: a suspended process beats again before they are over."""


@final
class LoopWatchdog:
    """Calls ``on_stall`` if a loop did not call ``beat`` during ``looks`` consecutive looks."""

    def __init__(
        self,
        on_stall: Callable[[], None] = lambda: os._exit(1),
        *,
        look_seconds: float = _STALL_LOOK_SECONDS,
        looks: int = _STALL_LOOKS,
    ) -> None:
        self._on_stall, self._look_seconds, self._looks = on_stall, look_seconds, looks
        self._beats = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name=type(self).__name__, daemon=True)
        self._thread.start()

    def beat(self) -> None:
        """Signals that the loop is running."""
        self._beats += 1

    def end(self) -> None:
        """Ends the watchdog."""
        self._ended.set()

    def _watch(self) -> None:
        stalled, seen = 0, self._beats
        while not self._ended.wait(self._look_seconds):
            stalled, seen = (stalled + 1, seen) if self._beats == seen else (0, self._beats)
            if stalled >= self._looks:
                seconds = self._looks * self._look_seconds
                sentence = f"the router's main loop has hung for {seconds:.0f} s; the process ends, to be restarted"
                log_event("router.stalled", sentence, level="error", service="router")
                self._on_stall()
                return
