"""Zenoh's own log as lines for a function of this process: Zenoh writes it to standard output and nowhere else."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import threading
from collections.abc import Callable
from typing import final

from safedpa.bus.log import log_event

__all__ = ["LogFile", "capture_zenoh_log"]

_GULP_BYTES = 1 << 20
_MOST_UNREAD = 8 << 20
"""bytes; what is older is passed over."""
_LONGEST_LINE = 1 << 16
_PAUSE_SECONDS = 0.02
_TOLD_SECONDS = 1.0
_NICE = 10
_PUNCH_HOLE, _KEEP_SIZE = 2, 1


def capture_zenoh_log(directives: str, hear: Callable[[str], None]) -> None:
    """From now on, for the whole process, hands every line of Zenoh's log to ``hear``, on a thread of its own.

    Must be called before the first session is opened; takes standard output for itself. Between them lies a file in
    memory, and no pipe: whoever writes to a full pipe waits for its reader or is told of an error, and of each error
    Zenoh would tell standard error, again waiting, while messages of the loop stand behind it. What a flood writes
    faster than it is read is passed over, and that is told once a second. The messages are refused all the same.
    """
    import zenoh

    file = LogFile()
    os.dup2(file.descriptor, 1)
    os.environ.update(RUST_LOG=directives, NO_COLOR="1")
    zenoh.init_log_from_env_or(directives)
    threading.Thread(target=_read, args=(file, hear), daemon=True).start()


@final
class LogFile:
    """A file in memory that grows at one end and is given back at the other as it is read."""

    def __init__(self, most_unread: int = _MOST_UNREAD) -> None:
        self.descriptor = os.memfd_create("zenoh-log", os.MFD_CLOEXEC)
        fcntl.fcntl(self.descriptor, fcntl.F_SETFL, os.O_APPEND)
        self._most_unread = most_unread
        self._read, self._rest = 0, b""
        self.passed_over = 0
        """bytes that nobody read."""

    def lines(self) -> list[str]:
        """Whole lines that came since the last call, a gulp of them at most; never waits."""
        behind = os.fstat(self.descriptor).st_size - self._read
        if behind > self._most_unread:
            self._read, self._rest = self._read + behind, b""
            self.passed_over += behind
        gulp = os.pread(self.descriptor, _GULP_BYTES, self._read)
        self._read += len(gulp)
        if gulp or behind > self._most_unread:
            self._give_back()
        *lines, rest = (self._rest + gulp).split(b"\n")
        self._rest = rest[-_LONGEST_LINE:]
        return [line.decode(errors="replace").rstrip() for line in lines]

    def _give_back(self) -> None:
        size = ctypes.c_int64(self._read)
        ctypes.CDLL(None).fallocate(self.descriptor, _PUNCH_HOLE | _KEEP_SIZE, ctypes.c_int64(0), size)


def _read(file: LogFile, hear: Callable[[str], None]) -> None:
    """In gulps, behind everything else: at every line a reader would be woken beside the messages' own way."""
    thread = threading.get_native_id()
    with contextlib.suppress(OSError):
        os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))  # --realtime is for the messages
        os.setpriority(os.PRIO_PROCESS, thread, _NICE)
    pause, told, looks = threading.Event(), 0, 0
    while True:
        for line in file.lines():
            hear(line)
        looks += 1
        if file.passed_over > told and looks * _PAUSE_SECONDS >= _TOLD_SECONDS:
            told, looks = file.passed_over, 0
            log_event("bus.log_overrun", "more was refused than could be told", level="warning", service="router")
        pause.wait(_PAUSE_SECONDS)
