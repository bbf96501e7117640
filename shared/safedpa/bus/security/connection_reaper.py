"""Keeps the doors of a listening process free: who connects and says nothing, or never gets in, holds nothing.

Zenoh accepts a connection before it knows who it is, so many of them could take every descriptor of the process, and
every place among those that wait to be let in. Three things help, and cost the traffic of those within nothing:

- the kernel hands a connection over only when its first bytes are there (TCP_DEFER_ACCEPT);
- who has sent something and is no member of the bus after a while is cut off, sooner where many of them wait;
- some descriptors are kept back. Where none is left, Zenoh would not even look at those that were cut off, since it
  first wants to accept the next one: then those kept back are let go for a moment, and taken again.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import socket
import stat
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import final

from safedpa.bus.logging import log_event

__all__ = ["ConnectionReaper", "cut_off", "defer_accept", "listening_ports", "raise_descriptor_limit"]

_SILENT_SECONDS = 250
"""For so long the kernel keeps who connected and said nothing; it costs it some hundred bytes, and us nothing."""
_MOST_WAITING = 65_535
"""In the kernel, for each socket; it takes the system's own limit (``net.core.somaxconn``) where that is less."""
_PATIENCE_SECONDS = 3.0
_HURRIED_SECONDS = 0.4
_MANY = 32
"""Connections on their way in, beyond which no one has as long."""
_SHORT_SECONDS = 0.1
"""Where no descriptor is left."""
_RETAINED_BACK = 160
"""Descriptors: more than Zenoh accepts before it looks at those it has."""
_ROOM_SECONDS = 0.25
_LOOK_SECONDS = 0.1
_REPORTED_SECONDS = 1.0
_MOST_DESCRIPTORS = 65_536

Address = tuple[str, int]


def raise_descriptor_limit() -> None:
    """Raises this process's own limit to the one that the system sets it."""
    with contextlib.suppress(ValueError, OSError):
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        wanted = min(hard, _MOST_DESCRIPTORS) if hard != resource.RLIM_INFINITY else _MOST_DESCRIPTORS
        if soft < wanted:
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def listening_ports() -> set[int]:
    """TCP ports on which this process listens."""
    return {port for port, _ in _listening()}


def defer_accept(ports: Collection[int]) -> None:
    """Has the kernel hold back silent connections at these ports, on which this process listens."""
    for port, found in _listening():
        if port in ports:
            with contextlib.suppress(OSError, AttributeError):
                found.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, _SILENT_SECONDS)
                found.listen(_MOST_WAITING)  # of a socket that listens already, this changes the number alone


def _listening() -> Iterator[tuple[int, socket.socket]]:
    for descriptor in _sockets():
        with contextlib.suppress(OSError), _borrowed(descriptor) as found:
            if found.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN) and found.family in _INTERNET:
                yield found.getsockname()[1], found


def cut_off(far_ends: Collection[Address]) -> int:
    """Ends the connections of this process to these addresses; how many there were."""
    count = 0
    for descriptor in _sockets():
        with contextlib.suppress(OSError, IndexError), _borrowed(descriptor) as found:
            if found.family in _INTERNET and tuple(found.getpeername()[:2]) in far_ends:
                found.shutdown(socket.SHUT_RDWR)
                count += 1
    return count


@dataclass
class _UnauthenticatedConnection:
    since: float
    peer: Address


@final
class ConnectionReaper:
    """Looks at the connections of this process to its ``ports``, on a thread of its own, and cuts off those that do not
    get in. ``members`` names the far ends of those that did. Needs no descriptor of its own."""

    def __init__(
        self,
        ports: set[int],
        members: Callable[[], Iterable[Address]],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._ports, self._members, self._clock = ports, members, clock
        self._strangers: dict[int, _UnauthenticatedConnection] = {}
        self._retained_back: list[int] = []
        self._keep_back()
        self._ended = threading.Event()
        self._cut, self._reported = 0, clock()
        self._thread = threading.Thread(target=self._watch, name=type(self).__name__, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Looks no more."""
        self._ended.set()
        self._thread.join()
        self._let_go()

    def look(self) -> int:
        """Cuts off who has been on the way in for too long; how many."""
        now, members = self._clock(), set(self._members())
        seen: dict[int, _UnauthenticatedConnection] = {}
        for descriptor, peer in self._connections():
            if peer in members:
                continue
            known = self._strangers.get(descriptor)
            seen[descriptor] = (
                known if known is not None and known.peer == peer else _UnauthenticatedConnection(now, peer)
            )
        short = not self._keep_back()
        patience = _SHORT_SECONDS if short else _HURRIED_SECONDS if len(seen) > _MANY else _PATIENCE_SECONDS
        late = {descriptor for descriptor, stranger in seen.items() if now - stranger.since > patience}
        for descriptor in late:
            with contextlib.suppress(OSError), _borrowed(descriptor) as found:
                if tuple(found.getpeername()[:2]) == seen[descriptor].peer:
                    found.shutdown(socket.SHUT_RDWR)  # its owner sees an end, and closes it
        self._strangers = {descriptor: item for descriptor, item in seen.items() if descriptor not in late}
        if short:
            self._let_go()
            self._ended.wait(_ROOM_SECONDS)
            self._keep_back()
        return len(late)

    def _keep_back(self) -> bool:
        """Takes descriptors up to the number to be kept back; whether there was one to be had."""
        highest = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        wanted = min(_RETAINED_BACK, highest // 6)
        try:
            while len(self._retained_back) < wanted:
                self._retained_back.append(os.dup(2))
            os.close(os.dup(2))
        except OSError:
            return False
        return True

    def _let_go(self) -> None:
        while self._retained_back:
            os.close(self._retained_back.pop())

    def _watch(self) -> None:
        while not self._ended.wait(_LOOK_SECONDS):
            self._cut += self.look()
            if self._cut and self._clock() - self._reported > _REPORTED_SECONDS:
                sentence = f"{self._cut} connections were cut off: they did not prove in time who they are"
                log_event("bus.strangers_cut_off", sentence, level="warning", count=self._cut)
                self._cut, self._reported = 0, self._clock()

    def _connections(self) -> Iterable[tuple[int, Address]]:
        for descriptor in _sockets():
            peer = self._peer(descriptor)
            if peer is not None:
                yield descriptor, peer

    def _peer(self, descriptor: int) -> Address | None:
        """The far end of a connection to our ports; None of what is none, listens, or is gone."""
        try:
            with _borrowed(descriptor) as found:
                if found.family in _INTERNET and found.getsockname()[1] in self._ports:
                    address = found.getpeername()
                    return address[0], address[1]
        except (OSError, IndexError):
            return None
        return None


_INTERNET = (socket.AF_INET, socket.AF_INET6)


def _sockets() -> Iterable[int]:
    """Descriptors of sockets, found by asking for each number: a list of them would want a descriptor itself."""
    highest = min(resource.getrlimit(resource.RLIMIT_NOFILE)[0], _MOST_DESCRIPTORS)
    absent = 0
    for first in range(0, highest, _AT_ONCE):
        numbers = range(first, min(first + _AT_ONCE, highest))
        with _ASKING:
            gone = {number for number, what in _question(numbers).poll(0) if what & select.POLLNVAL}
        absent = absent + 1 if len(gone) == len(numbers) else 0
        if absent == _LONGEST_GAP:
            return
        for descriptor in sorted({*numbers} - gone):
            with contextlib.suppress(OSError):  # closed meanwhile
                if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                    yield descriptor


_AT_ONCE = 512
"""Numbers that the kernel is asked about by one call: a call for each costs ten times as much."""
_ASKING = threading.Lock()
"""Each question is asked by one thread at a time: a second one would be told an error."""
_LONGEST_GAP = 4
"""Questions in a row that found no descriptor, after which none is looked for: the kernel gives out the lowest."""


@cache
def _question(numbers: range) -> select.poll:
    """Which of the numbers are descriptors, and no event of theirs."""
    asked = select.poll()
    for number in numbers:
        asked.register(number, 0)
    return asked


@contextlib.contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """The socket of a descriptor that is someone else's, and is not closed. Raises OSError where it is none now."""
    found = socket.socket(fileno=descriptor)
    try:
        yield found
    finally:
        found.detach()
