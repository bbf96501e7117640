"""The dashboard's loop: take what arrived, draw it, say that one lives."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from safedpa.bus import FINDING, HEALTH, LATENT, MODEL, NO_ROBOT, STATE, VERDICT, Bus, HealthMessage
from safedpa_services.dashboard.fleet_view import FleetView

if TYPE_CHECKING:
    from safedpa_services.dashboard.painter import Painter

__all__ = ["Dashboard"]

_TURN_SECONDS = 0.05
_WAIT_SECONDS = 0.25
_HEARTBEAT_SECONDS = 0.25


class Dashboard:
    """Draws the fleet of a bus until it is stopped. It only listens: nobody waits for it."""

    def __init__(self, bus: Bus, view: FleetView, painter: Painter, robot: str = "*", detail: str = "") -> None:
        self._bus = bus
        self._view = view
        self._painter = painter
        self._detail = detail
        self._complete = bus.inbox((STATE, VERDICT, FINDING, MODEL, HEALTH), robot, keep_all=True)
        self._newest = bus.inbox((LATENT,), robot)
        self._arranged = 0
        self._steps = 0
        self._next_heartbeat = time.monotonic()

    def run(self, stopped: Callable[[], bool]) -> None:
        """Turns until ``stopped`` says so; looks at it at least four times a second."""
        while not stopped():
            started = time.monotonic()
            self.turn(_WAIT_SECONDS)
            rest = _TURN_SECONDS - (time.monotonic() - started)
            if rest > 0.0:
                time.sleep(rest)  # several messages make one turn: it costs the machine less

    def end(self, sentence: str) -> None:
        """Draws what still arrived, and says why nothing more comes."""
        self.turn(0.0)
        self._painter.draw(self._view.end(sentence, time.monotonic()))

    def turn(self, longest_wait: float) -> None:
        """Draws what arrived; waits up to ``longest_wait`` [s] for something to draw."""
        waiting = self._complete.take(longest_wait)
        started = time.monotonic()
        frames = self._view.take(sorted([*waiting, *self._newest.take(0.0)], key=_order), started)
        if len(self._view.fields) != self._arranged:
            self._arranged = len(self._view.fields)
            self._painter.arrange(self._view.fields)
        self._painter.draw(frames)
        self._steps += bool(frames)
        if started >= self._next_heartbeat:
            self._next_heartbeat = started + _HEARTBEAT_SECONDS
            self._tell_health(time.monotonic() - started)

    def _tell_health(self, seconds: float) -> None:
        message = HealthMessage(
            epoch=0,
            tick=0,
            robot_time=0.0,
            publish_time=time.time(),
            service="dashboard",
            pid=os.getpid(),
            state="running" if self._view.fields else "ready",
            detail=self._detail,
            steps=self._steps,
            stale=self._view.left_out,
            refused=self._view.refused,
            step_microseconds=1e6 * seconds,
        )
        self._bus.publish(HEALTH, NO_ROBOT, message, "dashboard")


def _order(item: object) -> float:
    return getattr(item, "at", 0.0)
