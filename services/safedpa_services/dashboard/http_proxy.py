"""The web servers of the dashboard: the viewer's page, and a proxy in front of Rerun's data server.

Rerun's data server answers requests for any host name. A foreign web page could make its own host name resolve to this
machine (DNS rebinding) and read the data. The proxy therefore checks the host name and the origin of each request
before it forwards it to Rerun's server, which listens at a random loopback address. HTTP/2 without TLS is forwarded
unchecked: only the native viewer uses it, browsers cannot. Each connection carries one request, because further ones
would be forwarded unchecked.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import secrets
import socket
import threading
from collections.abc import Mapping, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from safedpa.errors import InputError, SafedpaError
from safedpa_services.web.hosts import Hosts
from safedpa_services.web.viewer import VIEWER_POLICY, Viewer

_MOST_CONNECTIONS = 64
_SILENCE_SECONDS = 10.0
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
    "Referrer-Policy": "no-referrer",
    "Content-Type": "text/plain; charset=utf-8",
}


class ViewerServer:
    """Serves the viewer's page, and redirects a browser without a data address to the data at ``grpc_port``.

    The address of the page is thereby short, and works from other machines, too. Requests for unknown host names are
    refused, as protection against DNS rebinding.
    """

    def __init__(self, bind: str, port: int, grpc_port: int, names: Sequence[str] = ()) -> None:
        hosts, viewer = Hosts(bind, names), Viewer()

        class Handler(BaseHTTPRequestHandler):
            timeout = _SILENCE_SECONDS
            server_version, sys_version = "safedpa", ""

            def do_GET(self) -> None:
                host = self.headers.get("Host", "")
                path, _, query = self.path.partition("?")
                if self.headers.get_all("Host", []) != [host] or not hosts.allow(host):
                    self._answer(403, b"this page is not served under that host name\n")
                elif path == "/" and "url=" not in query:
                    data = f"rerun%2Bhttp://{Hosts.without_port(host)}:{grpc_port}/proxy"
                    self._answer(302, b"", {"Location": f"/?url={data}"})
                else:
                    self._give(path.removeprefix("/"), host)

            def _give(self, name: str, host: str) -> None:
                try:
                    found = viewer.file(name)
                except SafedpaError as error:
                    self._answer(503, f"{error}\n".encode())
                    return
                if found is None:
                    self._answer(404, b"no such file\n")
                    return
                policy = VIEWER_POLICY.format(more=f" http://{Hosts.without_port(host)}:{grpc_port}")
                self._answer(200, found[0], {"Content-Type": found[1], "Content-Security-Policy": policy})

            def _answer(self, code: int, body: bytes, headers: Mapping[str, str] | None = None) -> None:
                self.send_response(code)
                for name, value in {**_HEADERS, **(headers or {}), "Content-Length": str(len(body))}.items():
                    self.send_header(name, value)
                self.end_headers()
                with contextlib.suppress(OSError):  # the browser closed the connection
                    self.wfile.write(body)

            def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002 - the name of the base class
                del format, arguments

        try:
            self._server = _BoundedHttpServer((bind, port), Handler)
        except OSError as error:
            raise InputError(f"--web-port {port}: {error.strerror}; choose another") from error
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Stops the server. The thread ends before the socket closes, because the descriptor may be reused."""
        self._server.shutdown()
        self._server.server_close()


class _BoundedHttpServer(ThreadingHTTPServer):
    """An HTTP server with a limited number of connections; idle ones are closed."""

    daemon_threads = True
    request_queue_size = 64

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self._room = threading.BoundedSemaphore(_MOST_CONNECTIONS)
        super().__init__(address, handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        del request, client_address  # a closed connection is not worth logging


FIRST_RERUN_PORT = 9920
"""First port to try for Rerun's data server at its private address."""
_MOST_AT_ONCE = 64
_LONGEST_HEAD = 16_384
_HEAD_SECONDS = 10.0
_CHUNK_BYTES = 1 << 16
_GUESSES = 20
_HTTP2_PREFACE = b"PRI * HTTP/2.0\r\n\r\n"
_REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_REQUEST = re.compile(rb"[A-Z]{1,20} /[!-~]* HTTP/1\.[01]")
_DROPPED = frozenset({b"connection", b"keep-alive", b"upgrade", b"http2-settings", b"proxy-connection"})
"""Request headers that are not forwarded: they would let the connection carry more than this request."""


def private_loopback() -> str:
    """Returns a random address of the loopback interface; 127.0.0.1 on systems that have only that one."""
    for _ in range(_GUESSES):
        address = f"127.{1 + secrets.randbelow(254)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.bind((address, 0))
            return address
    return "127.0.0.1"


class DataProxy:
    """Forwards requests from ``bind`` and ``port`` to ``behind`` if their host name and origin are allowed.

    ``names`` are further allowed host names. Raises InputError if the port is taken.
    """

    def __init__(self, bind: str, port: int, behind: tuple[str, int], names: Sequence[str] = ()) -> None:
        self._hosts, self._behind = Hosts(bind, names), behind
        self._open = 0
        family = socket.AF_INET6 if ":" in bind else socket.AF_INET
        try:
            listening = socket.create_server((bind, port), family=family, backlog=_MOST_AT_ONCE)
        except OSError as error:
            raise InputError(f"--grpc-port {port}: {error.strerror}; choose another") from error
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._serve, args=(listening,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stops the proxy."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def _serve(self, listening: socket.socket) -> None:
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(
            asyncio.start_server(self._on_connection, sock=listening, limit=_LONGEST_HEAD)
        )
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
                await self._answer(reader, writer)
        except (OSError, EOFError, ValueError, TimeoutError, asyncio.LimitOverrunError):
            pass  # closed, timed out, or unreadable
        finally:
            self._open -= 1
            writer.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _HEAD_SECONDS)
        wanted = head if head == _HTTP2_PREFACE else self.request(head)
        if wanted is None:
            writer.write(_REFUSED)
            await writer.drain()
            return
        data, sink = await asyncio.open_connection(*self._behind)
        try:
            sink.write(wanted)
            directions = {asyncio.ensure_future(_forward(reader, sink)), asyncio.ensure_future(_forward(data, writer))}
            _, pending = await asyncio.wait(directions, return_when=asyncio.FIRST_COMPLETED)
            for task in pending:
                task.cancel()
        finally:
            sink.close()

    def request(self, head: bytes) -> bytes | None:
        """Returns the head of a request to forward, alone on its connection; None if the request is refused."""
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


async def _forward(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while chunk := await reader.read(_CHUNK_BYTES):
            writer.write(chunk)
            await writer.drain()
