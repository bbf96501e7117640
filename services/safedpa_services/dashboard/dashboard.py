"""The dashboard's loop: take what arrived, draw it, say that one lives; and the same for what a recording holds."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from safedpa.bus import (
    FINDING,
    HEALTH,
    LATENT,
    MODEL,
    NO_ROBOT,
    STATE,
    SURROUNDINGS,
    VERDICT,
    Bus,
    HealthMessage,
    ReceivedMessage,
    decode,
    topic_of,
)
from safedpa.errors import MessageError
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_services.dashboard.look import DisplaySettings

if TYPE_CHECKING:
    from safedpa_services.dashboard.painter import RerunRecording

__all__ = ["Dashboard", "draw_recording"]

_TURN_SECONDS = 0.05
_WAIT_SECONDS = 0.25
_HEARTBEAT_SECONDS = 0.25


class Dashboard:
    """Draws the fleet of a bus until it is stopped. It only listens: no one waits for it."""

    def __init__(self, bus: Bus, view: FleetView, painter: RerunRecording, robot: str = "*", detail: str = "") -> None:
        self._bus = bus
        self._view = view
        self._painter = painter
        self._detail = detail
        self._complete = bus.inbox((STATE, VERDICT, FINDING, MODEL, HEALTH), robot, keep_all=True)
        self._newest = bus.inbox((LATENT, SURROUNDINGS), robot)
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
            self._report_health(time.monotonic() - started)

    def _report_health(self, seconds: float) -> None:
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


_TOPICS = (STATE, VERDICT, FINDING, MODEL, HEALTH, LATENT, SURROUNDINGS)
_BATCH_SECONDS = 0.25
"""Messages that are drawn together, by the clock of the recording."""


def draw_recording(files: Sequence[Path], look: DisplaySettings, path: Path) -> None:
    """Writes all robots of the recordings to an .rrd file. Raises InputError when it cannot be written."""
    from safedpa_services.dashboard.painter import RerunRecording

    view, fleet, known = FleetView(look), "recording", 0
    painter = RerunRecording(look, fleet, save=path, bind="127.0.0.1", grpc_port=None)
    for items in _batches(files):
        frames = view.take(list(items), items[-1].at)
        if len(view.fields) != known:
            known = len(view.fields)
            painter.arrange(view.fields)
        painter.draw(frames)
    painter.close()


def _batches(files: Sequence[Path]) -> Iterator[list[ReceivedMessage]]:
    batch: list[ReceivedMessage] = []
    for item in _received(files):
        if batch and item.at - batch[0].at > _BATCH_SECONDS:
            yield batch
            batch = []
        batch.append(item)
    if batch:
        yield batch


def _received(files: Sequence[Path]) -> Iterator[ReceivedMessage]:
    """As from the bus, with the time of recording [s] in place of the time of arrival."""
    from safedpa.records.readers.mcap import read_payloads

    for path in files:
        for key, at, topic, payload in read_payloads(path, topics=_TOPICS):
            try:
                message = decode(topic.message, payload)
            except MessageError:
                continue
            yield ReceivedMessage(topic, topic_of(key)[1], message, payload, key, 1e-9 * at)
