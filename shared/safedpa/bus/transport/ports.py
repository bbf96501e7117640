"""TCP ports for processes that are about to be started."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterable
from itertools import count
from pathlib import Path
from typing import final

from safedpa.errors import InputError

__all__ = ["free_port"]

_LOWEST, _EPHEMERAL = 20000, 32768
"""Ports that are handed out lie between, where the system's own choice for outgoing connections begins by default."""
_FEWEST = 1000
_SPACING = 1009
"""Ports between where two processes begin to look that were started one after the other."""
_RANGE = Path("/proc/sys/net/ipv4/ip_local_port_range")


def free_port(preferred: Iterable[int] = ()) -> int:
    """A TCP port of the loopback interface that no one listens on now: the first free one preferred, else any.

    No connection that goes out takes it before it is listened on, for the system gives those its ephemeral ports, and
    this process does not get it twice. Raises InputError when there is none.
    """
    for port in preferred:
        if _is_free(port):
            return port
    for port in _search.following():
        if _is_free(port):
            return port
    raise InputError("port: got none from the operating system; end some programs that listen")


@final
class _Search:
    """Where to look next; begins elsewhere in every process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._turns = count()
        self._process = 0

    def following(self) -> Iterable[int]:
        """Each port once, from the one behind the last that was handed out."""
        below = _first_ephemeral()
        size = below - _LOWEST
        for _ in range(size):
            with self._lock:
                if self._process != os.getpid():  # a fork looks from a place of its own
                    self._process, self._turns = os.getpid(), count(os.getpid() * _SPACING)
                turn = next(self._turns)
            yield _LOWEST + turn % size


_search = _Search()


def _first_ephemeral() -> int:
    """The system's first ephemeral port; the usual one where those reach so far down that few are left."""
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
