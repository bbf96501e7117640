"""Free TCP ports for processes that are about to be started."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import chain, count
from pathlib import Path

from safedpa.errors import InputError

# Ports are taken from 20000 to 32767: above the registered services in common use, below Linux's default range of
# ephemeral ports, from which the system takes ports for outgoing connections.
_LOWEST, _EPHEMERAL = 20000, 32768
# If the ephemeral range begins lower than this many ports above _LOWEST, the default range is used all the same.
_FEWEST = 1000
# Distance between the first candidates of processes with consecutive pids, so that they do not try the same ports. A
# prime, so that it shares no factor with the size of the range.
_SPACING = 1009
_RANGE = Path("/proc/sys/net/ipv4/ip_local_port_range")
_LOCK = threading.Lock()


def free_port(preferred: Iterable[int] = ()) -> int:
    """Returns a free TCP port of the loopback interface: the first free one of ``preferred``, otherwise any.

    The port is outside the ephemeral range, so no outgoing connection takes it before the caller listens on it. The
    same process does not get the same port again. Raises InputError if no port is free.
    """
    for port in chain(preferred, _candidates()):
        if _is_free(port):
            return port
    raise InputError("port: no TCP port is free; stop some programs that listen")


@cache
def _offsets(process: int) -> Iterator[int]:
    """Sequence of offsets of a process, which starts at another one in each; also in a fork."""
    return count(process * _SPACING)


def _candidates() -> Iterator[int]:
    """Yields each port once, starting after the last one that this process tried."""
    size = _first_ephemeral() - _LOWEST
    for _ in range(size):
        with _LOCK:  # count() is not documented as thread-safe
            offset = next(_offsets(os.getpid()))
        yield _LOWEST + offset % size


def _first_ephemeral() -> int:
    """Returns the system's first ephemeral port, or Linux's default if too few ports would remain below it."""
    try:
        first = int(_RANGE.read_text(encoding="ascii").split()[0])
    except (OSError, ValueError, IndexError):
        return _EPHEMERAL
    return first if first >= _LOWEST + _FEWEST else _EPHEMERAL


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
        return True
