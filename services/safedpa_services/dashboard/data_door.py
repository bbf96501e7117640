"""The door of the viewer's data: Rerun's own server answers under any name, so it stands behind this one.

A page on the web can have its own name resolve to this machine and then read what answers under that name. So here the
names of a request are looked at before Rerun's server hears of it, which listens at a loopback address that no page
can guess. A request to HTTP/2 that begins without TLS, as a viewer that is installed makes it and no browser does, is
handed on as it is. Each connection carries one request: what follows the first one was not looked at.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import secrets
import socket
import threading
from collections.abc import Sequence

from safedpa.errors import InputError
from safedpa_services.web.hosts import Hosts

__all__ = ["FIRST_OF_ITS_OWN", "DataDoor", "own_loopback"]

FIRST_OF_ITS_OWN = 9920
"""Port of Rerun's server at its own address, or the next free one."""
_MOST_CONNECTIONS = 64
_LONGEST_HEAD = 16_384
_HEAD_SECONDS = 10.0
_PIECE = 1 << 16
_ATTEMPTS = 20
_SECOND_VERSION = b"PRI * HTTP/2.0\r\n\r\n"
_REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_REQUEST = re.compile(rb"[A-Z]{1,20} /[!-~]* HTTP/1\.[01]")
_DROPPED = frozenset({b"connection", b"keep-alive", b"upgrade", b"http2-settings", b"proxy-connection"})
"""Of a request's headers: what would have the connection carry something else than this one request."""


def own_loopback() -> str:
    """An address of the loopback interface that nobody guesses, where the system has more than one (Linux)."""
    for _ in range(_ATTEMPTS):
        address = f"127.{1 + secrets.randbelow(254)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.bind((address, 0))
            return address
    return "127.0.0.1"


class DataDoor:
    """Listens at ``bind`` and ``port``, and hands on to ``behind`` what asks for it under a name of ours.

    ``names`` are those beside the machine's own. Raises InputError when the port is taken.
    """

    def __init__(self, bind: str, port: int, behind: tuple[str, int], names: Sequence[str] = ()) -> None:
        self._hosts, self._behind = Hosts(bind, names), behind
        self._open = 0
        family = socket.AF_INET6 if ":" in bind else socket.AF_INET
        try:
            listening = socket.create_server((bind, port), family=family, backlog=_MOST_CONNECTIONS)
        except OSError as error:
            raise InputError(f"--grpc-port {port}: {error.strerror}; choose another") from error
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._serve, args=(listening,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Answers no more."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def _serve(self, listening: socket.socket) -> None:
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(asyncio.start_server(self._let_in, sock=listening, limit=_LONGEST_HEAD))
        self._loop.run_forever()
        server.close()
        for task in asyncio.all_tasks(self._loop):
            task.cancel()
        self._loop.run_until_complete(asyncio.sleep(0))
        self._loop.close()

    async def _let_in(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._open += 1
        try:
            if self._open <= _MOST_CONNECTIONS:
                await self._answer(reader, writer)
        except (OSError, EOFError, ValueError, TimeoutError, asyncio.LimitOverrunError):
            pass  # it went away, said nothing, or nothing that can be read
        finally:
            self._open -= 1
            writer.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _HEAD_SECONDS)
        wanted = head if head == _SECOND_VERSION else self.request(head)
        if wanted is None:
            writer.write(_REFUSED)
            await writer.drain()
            return
        data, sink = await asyncio.open_connection(*self._behind)
        try:
            sink.write(wanted)
            ways = {asyncio.ensure_future(_hand_on(reader, sink)), asyncio.ensure_future(_hand_on(data, writer))}
            _, still = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for way in still:
                way.cancel()
        finally:
            sink.close()

    def request(self, head: bytes) -> bytes | None:
        """The head of a request as it is handed on, alone on its connection; None where it is refused."""
        first, *lines = head[:-4].split(b"\r\n")
        kept: list[bytes] = []
        found: dict[bytes, list[str]] = {b"host": [], b"origin": []}
        for line in lines:
            name, colon, value = line.partition(b":")
            if not colon or name != name.strip() or b"\n" in line or b"\r" in line or b"\0" in line:
                return None  # folded, or two lines for somebody else
            if name.lower() in found:
                found[name.lower()].append(value.strip().decode("latin-1"))
            if name.lower() not in _DROPPED:
                kept.append(line)
        if _REQUEST.fullmatch(first) is None:
            return None
        if len(found[b"host"]) != 1 or not self._hosts.allow(found[b"host"][0]):
            return None
        if not all(map(self._is_ours, found[b"origin"])):
            return None
        return b"\r\n".join((first, *kept, b"Connection: close", b"", b""))

    def _is_ours(self, origin: str) -> bool:
        """Whether a page of this machine asks: the viewer's own stands at another port."""
        scheme, mark, host = origin.partition("://")
        return bool(mark) and scheme in ("http", "https") and self._hosts.allow(host)


async def _hand_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while piece := await reader.read(_PIECE):
            writer.write(piece)
            await writer.drain()
