"""What the router does besides routing: it says by heartbeats that it lives, and how much it refused."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable

from safedpa.bus import HEALTH, NO_ROBOT, Bus, HealthMessage
from safedpa.bus.access import ROUTER
from safedpa_services.router.refusals import Refusals

__all__ = ["Router"]

_HEARTBEAT_SECONDS = 0.25


class Router:
    """Sends the heartbeats of a router's own session, with the number and the newest of its refusals."""

    def __init__(self, bus: Bus, refusals: Refusals) -> None:
        self._bus, self._refusals = bus, refusals
        self._beats = 0

    def run(self, stopped: Callable[[], bool]) -> None:
        """Beats until ``stopped`` says so."""
        pause = threading.Event()
        while not stopped():
            self.beat()
            pause.wait(_HEARTBEAT_SECONDS)

    def beat(self) -> None:
        """One heartbeat."""
        self._beats += 1
        message = HealthMessage(
            epoch=0,
            tick=0,
            robot_time=0.0,
            publish_time=time.time(),
            service=ROUTER,
            pid=os.getpid(),
            state="ready",
            steps=self._beats,
            detail=self._refusals.newest,
            refused=self._refusals.total,
        )
        self._bus.publish(HEALTH, NO_ROBOT, message, ROUTER)
