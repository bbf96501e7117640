"""Zenoh's own log as lines for a function of this process: Zenoh writes it to standard output and nowhere else."""

from __future__ import annotations

import contextlib
import fcntl
import os
import sys
import threading
from collections.abc import Callable

from safedpa.bus.log import log_event

__all__ = ["capture_zenoh_log"]

_PIPE_BYTES = 1 << 20
_LONGEST_LINE = 1 << 16
_PAUSE_SECONDS = 0.02
_NICE = 10
_LOST = "[tracing-subscriber] Unable to write"


def capture_zenoh_log(directives: str, hear: Callable[[str], None]) -> None:
    """From now on, for the whole process, hands every line of Zenoh's log to ``hear``, on a thread of its own.

    Must be called before the first session is opened; takes standard output for itself. The pipe between never makes
    the router wait: what a flood writes faster than it is read is lost, and that is told once a second. The messages
    are refused all the same.
    """
    import zenoh

    reading, writing = os.pipe()
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
    os.set_blocking(writing, False)
    os.dup2(writing, 1)
    os.close(writing)
    os.environ.update(RUST_LOG=directives, NO_COLOR="1")
    zenoh.init_log_from_env_or(directives)
    _reads(reading, hear)
    _watch_what_was_lost()


def _watch_what_was_lost() -> None:
    """Zenoh's logger complains of every lost line on standard error; everything else there goes on to where it went."""
    own = os.dup(2)
    sys.stderr = os.fdopen(own, "w", buffering=1)
    reading, writing = os.pipe()
    os.dup2(writing, 2)
    os.close(writing)

    def hear(line: str) -> None:
        if line.startswith(_LOST):
            log_event("bus.log_overrun", "more was refused than could be told", level="warning", service="router")
        elif line:
            sys.stderr.write(f"{line}\n")

    _reads(reading, hear)


def _reads(descriptor: int, hear: Callable[[str], None]) -> None:
    """Reads in gulps, behind everything else: at every line the reader would be woken beside the messages' own way."""

    def read() -> None:
        thread = threading.get_native_id()
        with contextlib.suppress(OSError):
            os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))  # --realtime is for the messages
            os.setpriority(os.PRIO_PROCESS, thread, _NICE)
        pause, rest = threading.Event(), b""
        while gulp := os.read(descriptor, _PIPE_BYTES):
            *lines, rest = (rest + gulp).split(b"\n")
            rest = rest[-_LONGEST_LINE:]
            for line in lines:
                hear(line.decode(errors="replace").rstrip())
            pause.wait(_PAUSE_SECONDS)

    threading.Thread(target=read, daemon=True).start()
