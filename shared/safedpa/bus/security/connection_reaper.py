"""Closes connections that do not authenticate in time, so that they cannot exhaust a listening process.

Zenoh accepts a connection before the client authenticates. Many such connections could occupy all file descriptors of
the process and all slots for pending handshakes. Three measures prevent that, without overhead for members of the bus:

- The kernel hands over a connection only once its first bytes have arrived (TCP_DEFER_ACCEPT).
- A connection that has sent something but is not a member after some time is closed; sooner if there are many.
- Some descriptors are kept in reserve. If no descriptor is left, Zenoh does not notice closed connections, because it
  first tries to accept the next one. Releasing the reserve for a moment lets it continue.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import stat
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from functools import cache
from typing import final

from safedpa.bus.logging import log_event

# How long the kernel keeps a silent connection. It takes some hundred bytes there and nothing in this process.
_SILENT_SECONDS = 250
# Length of the kernel's queue of a listening socket. As long as possible, because robots cannot connect while a flood
# fills it; the kernel lowers it to ``net.core.somaxconn``.
_BACKLOG = 65_535
# Time limit for a connection to become a member. A handshake takes 3 ms; 3 s tolerate a busy machine.
_TIMEOUT_SECONDS = 3.0
# Time limit if more connections than this are pending, as in a flood, whose connections would use up the descriptors.
_SHORT_TIMEOUT_SECONDS = 0.4
_MANY = 32
# Time limit while no descriptor is left: until a pending connection is closed, no robot can connect.
_EXHAUSTED_TIMEOUT_SECONDS = 0.1
# Descriptors in reserve: more than Zenoh accepts before it handles those that it has.
_RESERVE = 160
# How long the reserve is released, for Zenoh to accept and close connections.
_RELEASE_SECONDS = 0.25
_CHECK_SECONDS = 0.1
_REPORT_SECONDS = 1.0
# Enough for a thousand robots. A soft limit above it would make the scan for descriptors slow.
_MOST_DESCRIPTORS = 65_536

Address = tuple[str, int]


def raise_descriptor_limit() -> None:
    """Raises this process's soft limit of file descriptors to its hard limit, but not above 65 536."""
    import resource  # here, because the library has to be importable on systems without it

    with contextlib.suppress(ValueError, OSError):
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        wanted = min(hard, _MOST_DESCRIPTORS) if hard != resource.RLIM_INFINITY else _MOST_DESCRIPTORS
        if soft < wanted:
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _descriptor_limit() -> int:
    import resource

    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def listening_ports() -> set[int]:
    """Returns the TCP ports on which this process listens."""
    return {port for port, _ in _listening()}


def defer_accept(ports: Collection[int]) -> None:
    """Makes the kernel hold back silent connections to these ports, on which this process listens."""
    for port, found in _listening():
        if port in ports:
            with contextlib.suppress(OSError, AttributeError):
                found.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, _SILENT_SECONDS)
                # Zenoh's own backlog is short. On a listening socket, another call of listen only changes the backlog.
                found.listen(_BACKLOG)


def _listening() -> Iterator[tuple[int, socket.socket]]:
    for descriptor in _sockets():
        with contextlib.suppress(OSError), _borrowed(descriptor) as found:
            if found.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN) and found.family in _INTERNET:
                yield found.getsockname()[1], found


def cut_off(addresses: Collection[Address]) -> int:
    """Shuts down the connections of this process to these addresses; returns their number."""
    count = 0
    for descriptor in _sockets():
        with contextlib.suppress(OSError, IndexError), _borrowed(descriptor) as found:
            if found.family in _INTERNET and tuple(found.getpeername()[:2]) in addresses:
                found.shutdown(socket.SHUT_RDWR)
                count += 1
    return count


@final
class ConnectionReaper:
    """A thread that closes connections to ``ports`` of this process which do not become members in time.

    ``members`` returns the remote addresses of the members.
    """

    # Must work when no descriptor is left, so nothing in here may open one: no /proc, no epoll.

    def __init__(
        self,
        ports: set[int],
        members: Callable[[], Iterable[Address]],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._ports, self._members, self._clock = ports, members, clock
        self._pending: dict[int, tuple[float, Address]] = {}
        """Time [s] since which a connection is pending, and its peer, by descriptor."""
        self._reserve: list[int] = []
        self._fill_reserve()
        self._ended = threading.Event()
        self._cut, self._reported = 0, clock()
        self._thread = threading.Thread(target=self._watch, name=type(self).__name__, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the thread."""
        self._ended.set()
        self._thread.join()
        self._release_reserve()

    def check(self) -> int:
        """Closes connections that have been pending for too long; returns their number."""
        now, members = self._clock(), set(self._members())
        seen: dict[int, tuple[float, Address]] = {}
        for descriptor, peer in self._connections():
            if peer in members:
                continue
            # A descriptor may have been closed and reused since the last check; the peer address distinguishes the two.
            known = self._pending.get(descriptor)
            seen[descriptor] = known if known is not None and known[1] == peer else (now, peer)
        exhausted = not self._fill_reserve()
        many = len(seen) > _MANY
        timeout = _EXHAUSTED_TIMEOUT_SECONDS if exhausted else _SHORT_TIMEOUT_SECONDS if many else _TIMEOUT_SECONDS
        late = {descriptor for descriptor, (since, _) in seen.items() if now - since > timeout}
        for descriptor in late:
            with contextlib.suppress(OSError), _borrowed(descriptor) as found:
                if tuple(found.getpeername()[:2]) == seen[descriptor][1]:
                    # Not close: the descriptor belongs to Zenoh, which sees the end of the stream and closes it.
                    found.shutdown(socket.SHUT_RDWR)
        self._pending = {descriptor: item for descriptor, item in seen.items() if descriptor not in late}
        if exhausted:
            self._release_reserve()
            self._ended.wait(_RELEASE_SECONDS)
            self._fill_reserve()
        return len(late)

    def _fill_reserve(self) -> bool:
        """Fills the reserve of descriptors; returns whether another descriptor was free."""
        limit = _descriptor_limit()
        wanted = min(_RESERVE, limit // 6)
        try:
            # Duplicates of standard error: a descriptor that needs no file.
            while len(self._reserve) < wanted:
                self._reserve.append(os.dup(2))
            os.close(os.dup(2))
        except OSError:
            return False
        return True

    def _release_reserve(self) -> None:
        while self._reserve:
            os.close(self._reserve.pop())

    def _watch(self) -> None:
        while not self._ended.wait(_CHECK_SECONDS):
            self._cut += self.check()
            if self._cut and self._clock() - self._reported > _REPORT_SECONDS:
                sentence = f"closed {self._cut} connections that did not authenticate in time"
                log_event("bus.strangers_cut_off", sentence, level="warning", count=self._cut)
                self._cut, self._reported = 0, self._clock()

    def _connections(self) -> Iterator[tuple[int, Address]]:
        """Yields descriptor and remote address of each connection to the watched ports."""
        for descriptor in _sockets():
            with contextlib.suppress(OSError, IndexError), _borrowed(descriptor) as found:
                if found.family in _INTERNET and found.getsockname()[1] in self._ports:
                    address = found.getpeername()
                    yield descriptor, (address[0], address[1])


_INTERNET = (socket.AF_INET, socket.AF_INET6)


def _sockets() -> Iterable[int]:
    """Yields the descriptors of this process's sockets."""
    # Tests every number with poll, which reports POLLNVAL for a closed one. Reading /proc/self/fd would need a free
    # descriptor.
    limit = min(_descriptor_limit(), _MOST_DESCRIPTORS)
    empty_blocks = 0
    for first in range(0, limit, _BLOCK):
        numbers = range(first, min(first + _BLOCK, limit))
        with _POLL_LOCK:
            closed = {number for number, event in _poll_object(numbers).poll(0) if event & select.POLLNVAL}
        empty_blocks = empty_blocks + 1 if len(closed) == len(numbers) else 0
        if empty_blocks == _MOST_EMPTY_BLOCKS:
            return
        for descriptor in sorted({*numbers} - closed):
            with contextlib.suppress(OSError):  # closed since the poll
                if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                    yield descriptor


# Descriptors tested by one system call: one call for each takes ten times as long.
_BLOCK = 512
# A poll object raises an error if two threads poll it at the same time.
_POLL_LOCK = threading.Lock()
# The kernel assigns the lowest free number, so after this many blocks without a descriptor none follows.
_MOST_EMPTY_BLOCKS = 4


@cache
def _poll_object(numbers: range) -> select.poll:
    """Returns a poll object for these descriptors that reports no events but closed descriptors."""
    # Cached: registering 512 numbers takes longer than polling them.
    asked = select.poll()
    for number in numbers:
        asked.register(number, 0)
    return asked


@contextlib.contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """Wraps a descriptor owned by other code as a socket without closing it. Raises OSError if it is not a socket."""
    found = socket.socket(fileno=descriptor)
    try:
        yield found
    finally:
        found.detach()
