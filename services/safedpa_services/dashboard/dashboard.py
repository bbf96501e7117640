"""The dashboard's loop: draws what arrives on the bus and sends heartbeats. Also draws recordings."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from safedpa.bus import (
    FINDING,
    HEALTH,
    LATENT,
    MODEL,
    STATE,
    SURROUNDINGS,
    VERDICT,
    Bus,
    ReceivedMessage,
    decode,
    topic_of,
)
from safedpa.errors import MessageError
from safedpa_services.dashboard.display_settings import DisplaySettings
from safedpa_services.dashboard.fleet_view import FleetView

if TYPE_CHECKING:
    from safedpa_services.dashboard.rerun_recording import RerunRecording


_TURN_SECONDS = 0.05
_WAIT_SECONDS = 0.25
_HEARTBEAT_SECONDS = 0.25
_READ_SECONDS = 3.0
"""A viewer that has made data wait for longer gets fewer frames. One that has just been opened reads the history."""


class Dashboard:
    """Draws the fleet of a bus until it is stopped. It only observes: no process waits for it."""

    def __init__(
        self,
        bus: Bus,
        view: FleetView,
        recording: RerunRecording,
        robot: str = "*",
        detail: str = "",
        lag: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """``lag`` returns the time [s] for which the slowest viewer has made data wait."""
        self._bus = bus
        self._view = view
        self._recording = recording
        self._detail, self._lag = detail, lag
        self._complete = bus.inbox((STATE, VERDICT, FINDING, MODEL, HEALTH), robot, keep_all=True)
        self._newest = bus.inbox((LATENT, SURROUNDINGS), robot)
        self._steps = 0
        self._next_heartbeat = time.monotonic()

    def run(self, stopped: Callable[[], bool]) -> None:
        """Runs until ``stopped``, which is checked at least four times a second."""
        while not stopped():
            started = time.monotonic()
            self.turn(_WAIT_SECONDS)
            rest = _TURN_SECONDS - (time.monotonic() - started)
            if rest > 0.0:
                time.sleep(rest)  # collects several messages per turn, which takes less CPU time

    def end(self, sentence: str) -> None:
        """Draws the last messages, and shows ``sentence`` as the reason why nothing more arrives."""
        self.turn(0.0)
        self._recording.draw(self._view.end(sentence, time.monotonic()))

    def turn(self, longest_wait: float) -> None:
        """Draws what arrived, after waiting up to ``longest_wait`` [s] for messages."""
        items = self._complete.take(longest_wait)
        started = time.monotonic()
        items = [*items, *self._newest.take(0.0)]
        in_order = sorted(items, key=lambda item: getattr(item, "at", 0.0))
        frames = self._view.take(in_order, started, waited=self._lag() - _READ_SECONDS)
        self._recording.arrange(self._view.fields)
        self._recording.draw(frames)
        self._steps += bool(frames)
        if started >= self._next_heartbeat:
            self._next_heartbeat = started + _HEARTBEAT_SECONDS
            self._report_health(time.monotonic() - started)

    def _report_health(self, seconds: float) -> None:
        self._bus.report_health(
            "dashboard",
            state="running" if self._view.fields else "ready",
            detail=self._detail,
            steps=self._steps,
            stale=self._view.left_out,
            refused=self._view.refused,
            step_microseconds=1e6 * seconds,
        )


_TOPICS = (STATE, VERDICT, FINDING, MODEL, HEALTH, LATENT, SURROUNDINGS)
_BATCH_SECONDS = 0.25
"""Recorded time [s] whose messages are drawn together."""


def draw_recording(files: Sequence[Path], display: DisplaySettings, path: Path) -> None:
    """Draws all robots of recordings into an .rrd file. Raises InputError if it cannot be written."""
    from safedpa_services.dashboard.rerun_recording import RerunRecording

    view = FleetView(display)
    recording = RerunRecording(display, "recording", save=path, bind="127.0.0.1", grpc_port=None)
    for items in _batches(files):
        frames = view.take(list(items), items[-1].at)
        recording.arrange(view.fields)
        recording.draw(frames)
    recording.close()


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
    """Yields messages as if from the bus; the time of arrival is the time of recording [s]."""
    from safedpa.records.readers.mcap import read_payloads

    for path in files:
        for key, at, topic, payload in read_payloads(path, topics=_TOPICS):
            try:
                message = decode(topic.message, payload)
            except MessageError:
                continue
            yield ReceivedMessage(topic, topic_of(key)[1], message, payload, key, 1e-9 * at)
