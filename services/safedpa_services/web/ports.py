"""Chooses the port of a server of this package, and starts the server on it."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable

from safedpa.errors import InputError

_ATTEMPTS = 50


def choose_port(wanted: int | None, first: int, option: str, bind: str) -> int:
    """Returns the wanted port or, if None, the first free one from ``first`` on.

    Raises InputError if the wanted port is taken or none is free.
    """
    if wanted is not None:
        if not 0 < wanted < 65536 or not _is_free(wanted, bind):
            what = "a port that is taken or not allowed"
            raise InputError(f"{option} {wanted}: got {what}; choose another, or leave it out")
        return wanted
    for port in range(first, first + _ATTEMPTS):
        if _is_free(port, bind):
            return port
    raise InputError(f"{option}: no free port from {first} to {first + _ATTEMPTS - 1}; name one")


def open_server(start: Callable[[int], object], first: int, *, required: bool) -> int:
    """Starts a server with ``start(port)`` and returns its port.

    Tries ``first`` and, unless that is ``required``, the following ports: another process may have taken a port since
    it was found free. Raises InputError if none can be opened.
    """
    last = first if required else first + _ATTEMPTS - 1
    for port in range(first, last):
        with contextlib.suppress(InputError):
            start(port)
            return port
    start(last)
    return last


def _is_free(port: int, bind: str) -> bool:
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    try:
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((bind, port))
    except OSError:
        return False
    return True
