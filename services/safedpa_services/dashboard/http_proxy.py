"""The web servers of the dashboard: the viewer's page, and a proxy in front of Rerun's data server.

Rerun's data server answers requests for any host name. A foreign web page could make its own host name resolve to this
machine (DNS rebinding) and read the data. The proxy therefore checks the host name and the origin of each request
before it forwards it to Rerun's server, which listens at a random loopback address. HTTP/2 without TLS is forwarded
unchecked: only the native viewer uses it, browsers cannot. Each connection carries one request, because further ones
would be forwarded unchecked. The viewer's page is served in the same way.

Uvicorn would not close a connection whose request head never ends, and adds 84 modules to the start of the dashboard;
the TrustedHostMiddleware of Starlette compares names, and cannot allow numeric addresses.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import secrets
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from http import HTTPStatus

from safedpa.errors import InputError, SafedpaError
from safedpa_services.web.hosts import Hosts
from safedpa_services.web.viewer import VIEWER_POLICY, Viewer

FIRST_RERUN_PORT = 9920
"""First port to try for Rerun's data server at its private address."""
_MOST_AT_ONCE = 64
_LONGEST_HEAD = 16_384
_SILENCE_SECONDS = 10.0
"""Time for the head of a request, and for a part of an answer, after which the connection is closed."""
_CHUNK_BYTES = 1 << 16
_GUESSES = 20
_HTTP2_PREFACE = b"PRI * HTTP/2.0\r\n\r\n"
_REQUEST = re.compile(rb"[A-Z]{1,20} /[!-~]* HTTP/1\.[01]")
_DROPPED = frozenset({b"connection", b"keep-alive", b"upgrade", b"http2-settings", b"proxy-connection"})
"""Request headers that are not forwarded: they would let the connection carry more than this request."""
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
    "Referrer-Policy": "no-referrer",
    "Content-Type": "text/plain; charset=utf-8",
    "Connection": "close",
}


def private_loopback() -> str:
    """Returns a random address of the loopback interface; 127.0.0.1 on systems that have only that one."""
    for _ in range(_GUESSES):
        address = f"127.{1 + secrets.randbelow(254)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.bind((address, 0))
            return address
    return "127.0.0.1"


class _Door(ABC):
    """A server at ``bind`` and ``port`` that hears requests under allowed host names, and from pages under such names.

    ``names`` are further allowed host names. Raises InputError, which begins with ``option``, if the port is taken.
    """

    def __init__(self, bind: str, port: int, names: Sequence[str], option: str) -> None:
        self._hosts, self._open = Hosts(bind, names), 0
        family = socket.AF_INET6 if ":" in bind else socket.AF_INET
        try:
            listening = socket.create_server((bind, port), family=family, backlog=_MOST_AT_ONCE)
        except OSError as error:
            raise InputError(f"{option} {port}: {error.strerror}; choose another") from error
        self._loop, self._started = asyncio.new_event_loop(), threading.Event()
        self._thread = threading.Thread(target=self._serve, args=(listening,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stops the server."""
        # A loop that is stopped while the server starts leaves it, and its socket, half open.
        self._started.wait()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def _serve(self, listening: socket.socket) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            server = self._loop.run_until_complete(
                asyncio.start_server(self._on_connection, sock=listening, limit=_LONGEST_HEAD)
            )
        finally:
            self._started.set()
        self._loop.run_forever()
        server.close()
        for task in asyncio.all_tasks(self._loop):
            task.cancel()
        self._loop.run_until_complete(asyncio.sleep(0))
        self._loop.close()

    async def _on_connection(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._open += 1
        try:
            if self._open <= _MOST_AT_ONCE:
                head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _SILENCE_SECONDS)
                request = self.request(head)
                if request is None:
                    await _send(writer, _response(403, b"not served under that host name, or to that page\n"))
                else:
                    await self._answer(request, reader, writer)
        except (OSError, EOFError, ValueError, TimeoutError, asyncio.LimitOverrunError):
            pass  # closed, timed out, or unreadable
        finally:
            self._open -= 1
            writer.close()

    @abstractmethod
    async def _answer(self, request: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answers a request that is allowed."""

    def request(self, head: bytes) -> bytes | None:
        """Returns the head of a request, to be alone on its connection; None if the request is refused."""
        first, *lines = head[:-4].split(b"\r\n")
        forwarded: list[bytes] = []
        found: dict[bytes, list[str]] = {b"host": [], b"origin": []}
        for line in lines:
            name, colon, value = line.partition(b":")
            if not colon or name != name.strip() or b"\n" in line or b"\r" in line or b"\0" in line:
                return None  # folded headers, or line breaks that servers interpret differently
            if name.lower() in found:
                found[name.lower()].append(value.strip().decode("latin-1"))
            if name.lower() not in _DROPPED:
                forwarded.append(line)
        if _REQUEST.fullmatch(first) is None:
            return None
        if len(found[b"host"]) != 1 or not self._hosts.allow(found[b"host"][0]):
            return None
        if not all(map(self._is_own_origin, found[b"origin"])):
            return None
        return b"\r\n".join((first, *forwarded, b"Connection: close", b"", b""))

    def _is_own_origin(self, origin: str) -> bool:
        """Returns whether an origin is of this machine; the viewer's page has another port."""
        scheme, mark, host = origin.partition("://")
        return bool(mark) and scheme in ("http", "https") and self._hosts.allow(host)


class DataProxy(_Door):
    """Forwards requests to ``behind``."""

    def __init__(self, bind: str, port: int, behind: tuple[str, int], names: Sequence[str] = ()) -> None:
        self._behind = behind
        super().__init__(bind, port, names, "--grpc-port")

    def request(self, head: bytes) -> bytes | None:
        """Returns the head of a request to forward, alone on its connection; None if the request is refused."""
        return head if head == _HTTP2_PREFACE else super().request(head)

    async def _answer(self, request: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        data, sink = await asyncio.open_connection(*self._behind)
        try:
            sink.write(request)
            directions = {asyncio.ensure_future(_forward(reader, sink)), asyncio.ensure_future(_forward(data, writer))}
            _, pending = await asyncio.wait(directions, return_when=asyncio.FIRST_COMPLETED)
            for task in pending:
                task.cancel()
        finally:
            sink.close()


async def _forward(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while chunk := await reader.read(_CHUNK_BYTES):
            writer.write(chunk)
            await writer.drain()


class ViewerServer(_Door):
    """Serves the viewer's page, and redirects a browser without a data address to the data at ``grpc_port``.

    The address of the page is thereby short, and works from other machines, too.
    """

    def __init__(self, bind: str, port: int, grpc_port: int, names: Sequence[str] = ()) -> None:
        self._grpc_port, self._viewer = grpc_port, Viewer()
        super().__init__(bind, port, names, "--web-port")

    async def _answer(self, request: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await _send(writer, await asyncio.to_thread(self._page, request.decode("latin-1")))

    def _page(self, request: str) -> bytes:
        first, *lines = request.split("\r\n")
        method, target, _ = first.split(" ")
        (host,) = (line.partition(":")[2].strip() for line in lines if line.lower().startswith("host:"))
        data = f"http://{Hosts.without_port(host)}:{self._grpc_port}"
        path, _, query = target.partition("?")
        if method != "GET":
            return _response(405, b"wanted GET\n", {"Allow": "GET"})
        if path == "/" and "url=" not in query:
            return _response(302, b"", {"Location": f"/?url=rerun%2B{data}/proxy"})
        try:
            found = self._viewer.file(path.removeprefix("/"))
        except SafedpaError as error:
            return _response(503, f"{error}\n".encode())
        if found is None:
            return _response(404, b"no such file\n")
        content, kind = found
        policy = VIEWER_POLICY.format(more=f" {data}")
        return _response(200, content, {"Content-Type": kind, "Content-Security-Policy": policy})


def _response(code: int, body: bytes, headers: Mapping[str, str] | None = None) -> bytes:
    named = {**_HEADERS, "Content-Length": str(len(body)), **(headers or {})}
    lines = [f"HTTP/1.1 {code} {HTTPStatus(code).phrase}", *(f"{name}: {value}" for name, value in named.items())]
    return "\r\n".join([*lines, "", ""]).encode("latin-1") + body


async def _send(writer: asyncio.StreamWriter, content: bytes) -> None:
    """Sends an answer in parts, so that a client that stops to read is noticed."""
    for start in range(0, len(content), _CHUNK_BYTES):
        writer.write(content[start : start + _CHUNK_BYTES])
        await asyncio.wait_for(writer.drain(), _SILENCE_SECONDS)
