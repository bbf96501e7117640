"""What the router does besides routing: it says that it lives, how much it refused, and who is there twice."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable

from safedpa.bus import HEALTH, NO_ROBOT, Bus, HealthMessage
from safedpa.bus.access import ROLES, ROUTER
from safedpa.bus.log import log_event
from safedpa_services.router.refusals import Refusals

__all__ = ["Router", "Twins"]

_HEARTBEAT_SECONDS = 0.25
_BEATS_A_LOOK = 8
"""A session that was lost is gone within the lease of half a second."""

Members = Callable[[], Iterable[tuple[str, str]]]
"""(Zenoh id, common name) of every session that is linked."""


class Twins:
    """Finds certificates that two processes show at once: a copy in wrong hands, or a service that was started twice.

    Only roles that announce themselves are one process each: people and health checks come and go in any number.
    """

    def __init__(self, members: Members) -> None:
        self._members = members
        self._before: set[str] = set()

    def look(self) -> list[str]:
        """Names that have been there twice since the last look; each is told as ``bus.twice``."""
        sessions: dict[str, set[str]] = {}
        for session, name in self._members():
            role = ROLES.get(name.partition(".")[0])
            if role is not None and role.lives:
                sessions.setdefault(name, set()).add(session)
        now = {name for name, found in sessions.items() if len(found) > 1}
        lasting = sorted(now & self._before)
        self._before = now
        for name in lasting:
            sentence = f"{len(sessions[name])} processes show the certificate of {name}: one of them is a copy"
            log_event("bus.twice", sentence, level="warning", service=name)
        return lasting


class Router:
    """Sends the heartbeats of a router's own session, with the number and the newest of its refusals."""

    def __init__(self, bus: Bus, refusals: Refusals, members: Members = tuple) -> None:
        self._bus, self._refusals = bus, refusals
        self._twins = Twins(members)
        self._twice: list[str] = []
        self._beats = 0

    def run(self, stopped: Callable[[], bool]) -> None:
        """Beats until ``stopped`` says so."""
        pause = threading.Event()
        while not stopped():
            self.beat()
            pause.wait(_HEARTBEAT_SECONDS)

    def beat(self) -> None:
        """One heartbeat, and now and then a look at who is there."""
        self._beats += 1
        if self._beats % _BEATS_A_LOOK == 0:
            self._twice = self._twins.look()
        message = HealthMessage(
            epoch=0,
            tick=0,
            robot_time=0.0,
            publish_time=time.time(),
            service=ROUTER,
            pid=os.getpid(),
            state="ready",
            detail=f"twice: {', '.join(self._twice)}" if self._twice else self._refusals.newest,
            steps=self._beats,
            refused=self._refusals.total,
        )
        self._bus.publish(HEALTH, NO_ROBOT, message, ROUTER)
