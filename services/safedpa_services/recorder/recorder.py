"""Everything that is said on the bus, in order of arrival, into one file. A full disk stops the file, not the car."""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Callable
from pathlib import Path

from safedpa.bus import HEALTH, NO_ROBOT, TOPICS, Bus, HealthMessage, Received
from safedpa.errors import RecordingError
from safedpa.records import McapRecorder

__all__ = ["Recorder"]

_FLUSH_SECONDS = 0.5
_TURN_SECONDS = 0.05


class Recorder:
    """Writes messages until told to stop; says in its health when it cannot write any more."""

    def __init__(self, bus: Bus, path: Path, robot: str = "*") -> None:
        self._bus = bus
        self._inbox = bus.inbox(tuple(TOPICS.values()), robot, keep_all=True)
        self._file: McapRecorder | None = McapRecorder(path)
        self._error = ""
        self._written = 0
        self._refused = 0
        bus.announce(NO_ROBOT, "recorder", uuid.uuid4().hex[:12])

    def run(self, stopped: Callable[[], bool]) -> int:
        """Records until ``stopped``; returns 0, or 1 when writing failed on the way."""
        next_flush = time.monotonic()
        while not stopped():
            self.turn(_TURN_SECONDS)
            if time.monotonic() >= next_flush:
                next_flush = time.monotonic() + _FLUSH_SECONDS
                self._guarded(lambda file: file.flush())
                self._tell_health()
        self.turn(0.0)
        self._guarded(lambda file: file.close())
        self._tell_health()  # the last word: whether everything was kept
        return 1 if self._error else 0

    def turn(self, wait: float) -> None:
        """Writes what arrived within ``wait`` [s]."""
        time.sleep(wait)  # not woken by every message: the loop has the processor first
        for item in self._inbox.take(0.0):
            if isinstance(item, Received):
                self._write(item)
            else:
                self._refused += 1

    def _write(self, item: Received) -> None:
        published = int(1e9 * item.message.publish_time)
        arrived = time.time_ns() - int(1e9 * (time.monotonic() - item.at))
        self._guarded(lambda file: file.write(item.key, item.payload, arrived, published))
        self._written += 1

    def _guarded(self, work: Callable[[McapRecorder], None]) -> None:
        if self._file is None:
            return
        try:
            work(self._file)
        except RecordingError as error:
            self._error, self._file = str(error), None

    def _tell_health(self) -> None:
        message = HealthMessage(
            epoch=0,
            tick=0,
            robot_time=0.0,
            publish_time=time.time(),
            service="recorder",
            pid=os.getpid(),
            state="failing" if self._error else "running",
            detail=self._error or (f"{self._inbox.dropped} messages lost" if self._inbox.dropped else ""),
            steps=self._written,
            refused=self._refused,
        )
        self._bus.publish(HEALTH, NO_ROBOT, message, "recorder")
