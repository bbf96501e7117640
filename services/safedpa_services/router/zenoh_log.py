"""Zenoh's own log as lines for a function of this process: Zenoh writes it to standard output and nowhere else."""

from __future__ import annotations

import fcntl
import os
import threading
from collections.abc import Callable

__all__ = ["capture_zenoh_log"]

_PIPE_BYTES = 1 << 20


def capture_zenoh_log(directives: str, hear: Callable[[str], None]) -> None:
    """From now on, for the whole process, hands every line of Zenoh's log to ``hear``, on a thread of its own.

    Must be called before the first session is opened; takes standard output for itself. The pipe between never makes
    the router wait: what a flood writes faster than it is read is lost, and the messages themselves are refused all the same.
    """
    import zenoh

    reading, writing = os.pipe()
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
    os.set_blocking(writing, False)
    os.dup2(writing, 1)
    os.close(writing)
    os.environ.update(RUST_LOG=directives, NO_COLOR="1")
    zenoh.init_log_from_env_or(directives)
    threading.Thread(target=_read, args=(reading, hear), daemon=True).start()


def _read(descriptor: int, hear: Callable[[str], None]) -> None:
    with os.fdopen(descriptor, "rb", buffering=_PIPE_BYTES) as lines:
        for line in lines:
            hear(line.decode(errors="replace").rstrip())
