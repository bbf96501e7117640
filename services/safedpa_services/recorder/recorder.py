"""Records all messages of the bus into one file, in order of arrival. A full disk stops the recording, not the robot.

A message is acknowledged once it is on disk (fsync). The health message reports how many of the received messages are
acknowledged, in order of arrival. Acknowledged messages remain readable if the process, the machine or the network
fails afterwards.
"""

from __future__ import annotations

import errno
import shutil
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from safedpa.bus import (
    LATENT,
    NO_ROBOT,
    NOMINAL,
    SETUP,
    SURROUNDINGS,
    TOPICS,
    VERDICT,
    Bus,
    HealthMessage,
    ReceivedMessage,
    SetupMessage,
)
from safedpa.bus.logging import log_event
from safedpa.errors import RecordingError
from safedpa.records import McapRecorder

_SYNC_SECONDS = 0.5
_TURN_SECONDS = 0.05
_SETUP_SECONDS = 5.0
_RETRY_SECONDS = 5.0
_RESUME_BYTES = 64 * 1024 * 1024
"""Free disk space required before a recording resumes in a new file after the disk was full."""
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
_REPLAYED = frozenset(topic.writer for topic in (LATENT, SURROUNDINGS, NOMINAL, VERDICT))
"""Services that ``safedpa replay`` runs again, for which it needs their setup messages."""


class Recorder:
    """Writes messages until stopped; its health message reports how many are on disk, and why it cannot write.

    When the disk is full, it waits for free space and resumes in a new file next to the first. The new file begins with
    all setup messages.
    """

    def __init__(self, bus: Bus, path: Path, setup: SetupMessage, robot: str = "*") -> None:
        self._bus, self._path, self._setup = bus, path, setup
        self._about = {"format": "2", "fleet": bus.fleet, "software": setup.software, "robot": robot}
        self._inbox = bus.inbox(tuple(TOPICS.values()), robot, keep_all=True)
        self._fleet = bus.inbox((SETUP,), NO_ROBOT, keep_all=True) if robot != "*" else None
        self._file: McapRecorder | None = McapRecorder(path, self._about)
        self._setups: dict[str, bytes] = {}
        """By key: the newest setup message. It is written once, and again at the start of every further file."""
        self._services: set[str] = set()
        """Services that sent a heartbeat."""
        self._error = ""
        self._is_full = False
        self._retained = 0
        """Acknowledged messages in earlier files."""
        self._written = self._refused = self._lost = self._dropped = 0
        self._next_retry = self._next_setup = 0.0
        bus.announce(NO_ROBOT, "recorder", setup.instance)

    @property
    def acknowledged(self) -> int:
        """Number of received messages that are on disk."""
        return self._retained + (0 if self._file is None else self._file.acknowledged)

    @property
    def missing(self) -> str:
        """What the recording lacks, as a sentence; empty if it is complete."""
        if self._error:
            return self._error
        if self._inbox.dropped:
            return f"{self._inbox.dropped} messages lost"
        recorded = {key.rsplit("/", 1)[1] for key in self._setups}
        services = sorted((self._services & _REPLAYED) - recorded)
        return f"no setup message of {', '.join(services)} arrived; 'safedpa replay' needs them" if services else ""

    def run(self, stopped: Callable[[], bool]) -> int:
        """Records until ``stopped``; returns 0, or 1 if the recording is incomplete."""
        next_sync = time.monotonic()
        while not stopped():
            self.turn(_TURN_SECONDS)
            if time.monotonic() >= next_sync:
                next_sync = time.monotonic() + _SYNC_SECONDS
                self.sync()
        self.turn(0.0)
        self._guarded(McapRecorder.close)
        self._report_health(is_last=True)
        return 1 if self.missing else 0

    def turn(self, wait: float) -> None:
        """Writes the messages that arrive within ``wait`` [s]."""
        time.sleep(wait)  # instead of waking up for every message, which would take CPU time from the control loop
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
                "recorder.lost", "messages arrived faster than they were written", level="error", service="recorder",
                lost=self._dropped,
            )  # fmt: skip

    def sync(self) -> None:
        """Waits for the disk and acknowledges; after a full disk, tries to resume."""
        self._guarded(McapRecorder.sync)
        if self._file is None and self._is_full and time.monotonic() >= self._next_retry:
            self._next_retry = time.monotonic() + _RETRY_SECONDS
            self._resume()
        self._report_health()
        if time.monotonic() >= self._next_setup:
            self._next_setup = time.monotonic() + _SETUP_SECONDS
            self._bus.publish(SETUP, NO_ROBOT, self._setup, "recorder")

    def _take(self, item: ReceivedMessage) -> None:
        if isinstance(item.message, HealthMessage):
            self._services.add(item.message.service)
        if item.topic is SETUP:
            if self._setups.get(item.key) == item.payload:
                return  # services repeat their setup for processes that join later
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
            self._is_full = getattr(error.__cause__, "errno", None) in _DISK_FULL
            self._retained += self._file.acknowledged
            self._error, self._file = str(error), None
            log_event("recorder.failed", self._error, level="error", service="recorder", written=self._written)

    def _resume(self) -> None:
        """Opens a new file next to the old one if there is enough free space."""
        if _free_bytes(self._path) < _RESUME_BYTES:
            return
        try:
            self._file = McapRecorder(self._path, self._about)
        except RecordingError:  # tried again after _RETRY_SECONDS
            return
        log_event(
            "recorder.resumed",
            f"the recording resumes in a new file next to {self._path}",
            service="recorder",
            lost=self._lost,
        )
        now = time.time_ns()
        for key, payload in self._setups.items():
            self._guarded(partial(McapRecorder.write, key=key, payload=payload, log_time_ns=now, publish_time_ns=now))
        self._guarded(McapRecorder.sync)
        # These setups were counted in the first file.
        self._retained -= 0 if self._file is None else self._file.acknowledged

    def _report_health(self, *, is_last: bool = False) -> None:
        """The last health message is ``failing`` if the recording is incomplete, even if it resumed after a failure."""
        failing = self._file is None or (is_last and bool(self.missing))
        self._bus.report_health(
            "recorder",
            state="failing" if failing else "running",
            detail=self._detail(is_last=is_last),
            steps=self._written,
            refused=self._refused,
            acknowledged=self.acknowledged,
            free_bytes=_free_bytes(self._path),
        )

    def _detail(self, *, is_last: bool) -> str:
        lost = self._lost + self._inbox.dropped
        text = f"{lost} messages lost" if lost else ""
        if self._error and self._file is not None:
            return f"{text}; resumed in {self._file.path.name}; {self._error}"
        if self._file is not None:
            return text or (self.missing if is_last else "")
        waits = f"; resumes when {_RESUME_BYTES >> 20} MiB are free" if self._is_full else ""
        return f"{self._error}{waits}"


def _free_bytes(path: Path) -> int:
    try:
        return shutil.disk_usage(path.parent).free
    except OSError:
        return 0
