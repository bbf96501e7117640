"""Everything that is said on the bus, in order of arrival, into one file. A full disk stops the file, not the car.

A message is acknowledged when it is known to be on the disk (fsync): the health message says how many of those that
this process received are, counted in order of arrival. Whatever happens afterwards to process, machine or network,
these messages can be read.
"""

from __future__ import annotations

import errno
import os
import shutil
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from safedpa.bus import HEALTH, NO_ROBOT, SETUP, TOPICS, Bus, HealthMessage, ReceivedMessage, SetupMessage
from safedpa.bus.logging import log_event
from safedpa.bus.messages.service_info import software_version
from safedpa.errors import RecordingError
from safedpa.records import McapRecorder

__all__ = ["Recorder"]

_SYNC_SECONDS = 0.5
_TURN_SECONDS = 0.05
_SETUP_SECONDS = 5.0
_RETRY_SECONDS = 5.0
_ROOM_BYTES = 64 * 1024 * 1024
"""Of free disk, before a recording that broke off on a full one goes on in another file."""
_FULL = (errno.ENOSPC, errno.EDQUOT)


class Recorder:
    """Writes messages until told to stop; says in its health how many are on the disk, and why it cannot write.

    When the disk is full it waits for room and goes on in a file next to the first, which begins with all setups.
    """

    def __init__(self, bus: Bus, path: Path, setup: SetupMessage, robot: str = "*") -> None:
        self._bus, self._path, self._setup = bus, path, setup
        self._about = {"format": "2", "fleet": bus.fleet, "software": setup.software, "robot": robot}
        self._inbox = bus.inbox(tuple(TOPICS.values()), robot, keep_all=True)
        self._fleet = bus.inbox((SETUP,), NO_ROBOT, keep_all=True) if robot != "*" else None
        self._file: McapRecorder | None = McapRecorder(path, self._about)
        self._setups: dict[str, bytes] = {}
        """The newest setup of every process, which is written once and at the begin of every file."""
        self._error = ""
        self._is_full = False
        self._retained = 0
        """Messages that are on the disk, in files before this one."""
        self._written = self._refused = self._lost = self._dropped = 0
        self._next_retry = self._next_setup = 0.0
        bus.announce(NO_ROBOT, "recorder", setup.instance)

    @property
    def acknowledged(self) -> int:
        """Messages that are on the disk, of those that were received."""
        return self._retained + (0 if self._file is None else self._file.acknowledged)

    def run(self, stopped: Callable[[], bool]) -> int:
        """Records until ``stopped``; returns 0, or 1 when writing failed on the way."""
        next_sync = time.monotonic()
        while not stopped():
            self.turn(_TURN_SECONDS)
            if time.monotonic() >= next_sync:
                next_sync = time.monotonic() + _SYNC_SECONDS
                self.sync()
        self.turn(0.0)
        self._guarded(McapRecorder.close)
        self._report_health(is_last=True)
        return 1 if self._error else 0

    def turn(self, wait: float) -> None:
        """Writes what arrived within ``wait`` [s]."""
        time.sleep(wait)  # not woken by every message: the loop has the processor first
        items = self._inbox.take(0.0)
        items += [] if self._fleet is None else self._fleet.take(0.0)
        for item in items:
            if isinstance(item, ReceivedMessage):
                self._take(item)
            else:
                self._refused += 1
        if self._inbox.dropped > self._dropped:
            self._dropped = self._inbox.dropped
            log_event(
                "recorder.lost", "messages came faster than they were written", level="error", service="recorder",
                lost=self._dropped,
            )  # fmt: skip

    def sync(self) -> None:
        """Waits for the disk and acknowledges; after a full disk, tries to go on."""
        self._guarded(McapRecorder.sync)
        if self._file is None and self._is_full and time.monotonic() >= self._next_retry:
            self._next_retry = time.monotonic() + _RETRY_SECONDS
            self._go_on()
        self._report_health()
        if time.monotonic() >= self._next_setup:
            self._next_setup = time.monotonic() + _SETUP_SECONDS
            self._bus.publish(SETUP, NO_ROBOT, self._setup, "recorder")

    def _take(self, item: ReceivedMessage) -> None:
        if item.topic is SETUP:
            if self._setups.get(item.key) == item.payload:
                return  # said again for those who joined late
            self._setups[item.key] = item.payload
        published = int(1e9 * item.message.publish_time)
        arrived = time.time_ns() - int(1e9 * (time.monotonic() - item.at))
        key, payload = item.key, item.payload
        self._guarded(lambda file: file.write(key, payload, arrived, published))
        self._written += self._file is not None
        self._lost += self._file is None

    def _guarded(self, work: Callable[[McapRecorder], None]) -> None:
        if self._file is None:
            return
        try:
            work(self._file)
        except RecordingError as error:
            self._is_full = getattr(error.__cause__, "errno", None) in _FULL
            self._retained += self._file.acknowledged
            self._error, self._file = str(error), None
            log_event("recorder.failed", self._error, level="error", service="recorder", written=self._written)

    def _go_on(self) -> None:
        """A new file next to the old one, as soon as there is room."""
        if _free_bytes(self._path) < _ROOM_BYTES:
            return
        try:
            self._file = McapRecorder(self._path, self._about)
        except RecordingError:  # not yet
            return
        log_event("recorder.resumed", f"goes on next to {self._path}", service="recorder", lost=self._lost)
        now = time.time_ns()
        for key, payload in self._setups.items():
            self._guarded(partial(McapRecorder.write, key=key, payload=payload, log_time_ns=now, publish_time_ns=now))
        self._guarded(McapRecorder.sync)
        self._retained -= 0 if self._file is None else self._file.acknowledged  # written before, so not counted again

    def _report_health(self, *, is_last: bool = False) -> None:
        """The last word tells of every failure on the way, also of one that was overcome."""
        failing = self._file is None or (is_last and bool(self._error))
        message = HealthMessage(
            epoch=0,
            tick=0,
            robot_time=0.0,
            publish_time=time.time(),
            service="recorder",
            pid=os.getpid(),
            state="failing" if failing else "running",
            detail=self._detail(),
            steps=self._written,
            refused=self._refused,
            software=software_version(),
            acknowledged=self.acknowledged,
            free_bytes=_free_bytes(self._path),
        )
        self._bus.publish(HEALTH, NO_ROBOT, message, "recorder")

    def _detail(self) -> str:
        lost = self._lost + self._inbox.dropped
        reported = f"{lost} messages lost" if lost else ""
        if self._error and self._file is not None:
            reported = f"{reported}; goes on in {self._file.path.name}; {self._error}"
        if self._file is not None:
            return reported
        waits = f"; goes on when {_ROOM_BYTES >> 20} MiB are free" if self._is_full else ""
        return f"{self._error}{waits}"


def _free_bytes(path: Path) -> int:
    try:
        return shutil.disk_usage(path.parent).free
    except OSError:
        return 0
