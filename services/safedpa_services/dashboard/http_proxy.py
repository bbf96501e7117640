"""The viewer's doors, and ports for them.

A short address at which a browser gets the viewer with all that it needs; and the door of the viewer's data: Rerun's
own server answers under any name, so it stands behind this one. A page on the web can have its own name resolve to this
machine and then read what answers under that name. So here the names of a request are looked at before Rerun's server
hears of it, which listens at a loopback address that no page can guess. A request to HTTP/2 that begins without TLS, as
a viewer that is installed makes it and no browser does, is handed on as it is. Each connection carries one request:
what follows the first one was not looked at.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import secrets
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from safedpa.errors import InputError, SafedpaError
from safedpa_services.web.hosts import Hosts
from safedpa_services.web.viewer import VIEWER_POLICY, Viewer

__all__ = ["FIRST_OF_ITS_OWN", "DataProxy", "ViewerServer", "choose_port", "open_server", "private_loopback"]

_ATTEMPTS = 50
_MOST_CONNECTIONS = 64
_SILENCE_SECONDS = 10.0
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
    "Referrer-Policy": "no-referrer",
    "Content-Type": "text/plain; charset=utf-8",
}
_HOST = re.compile(r"[A-Za-z0-9.-]+|\[[0-9A-Fa-f:.]+\]")


def choose_port(wanted: int | None, first: int, option: str, bind: str) -> int:
    """The wanted port, or, if none is required, the first free one from ``first`` on.

    Raises InputError when the wanted one is taken or none is free.
    """
    if wanted is not None:
        if not 0 < wanted < 65536 or not _is_free(wanted, bind):
            raise InputError(f"{option} {wanted}: taken or not allowed; choose another, or leave it out for a free one")
        return wanted
    for port in range(first, first + _ATTEMPTS):
        if _is_free(port, bind):
            return port
    raise InputError(f"{option}: no free port from {first} to {first + _ATTEMPTS - 1}; name one")


def open_server(door: Callable[[int], object], first: int, *, required: bool) -> int:
    """The port at which a door was opened: ``first``, or the next where that was taken since it was chosen.

    Another dashboard that is started at the same moment looks at the same ports. Raises InputError where the first was
    requested, or none of so many can be had.
    """
    last = first if required else first + _ATTEMPTS - 1
    for port in range(first, last):
        with contextlib.suppress(InputError):
            door(port)
            return port
    door(last)
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


class ViewerServer:
    """Serves the viewer's program, and sends a browser that comes without an address of data to those of ``grpc_port``.

    So the address to remember is short, and works from another machine as it does from this one. Asked for under a
    name that no one named it answers nothing: another page could have had its own name resolve to this machine.
    """

    def __init__(self, bind: str, port: int, grpc_port: int, names: Sequence[str] = ()) -> None:
        hosts, viewer = Hosts(bind, names), Viewer()

        class Answering(BaseHTTPRequestHandler):
            timeout = _SILENCE_SECONDS
            server_version, sys_version = "safedpa", ""

            def do_GET(self) -> None:
                host = self.headers.get("Host", "")
                path, _, query = self.path.partition("?")
                if self.headers.get_all("Host", []) != [host] or not hosts.allow(host):
                    self._answer(403, b"this page is not served under that name\n")
                elif path == "/" and "url=" not in query:
                    self._answer(302, b"", {"Location": _with_data(host, grpc_port)})
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
                data = f" http://{_name_of(host)}:{grpc_port}"
                policy = {"Content-Security-Policy": VIEWER_POLICY.format(more=data)}
                self._answer(200, found[0], {"Content-Type": found[1], **policy})

            def _answer(self, code: int, body: bytes, headers: Mapping[str, str] | None = None) -> None:
                self.send_response(code)
                for name, value in {**_HEADERS, **(headers or {}), "Content-Length": str(len(body))}.items():
                    self.send_header(name, value)
                self.end_headers()
                with contextlib.suppress(OSError):  # it is gone
                    self.wfile.write(body)

            def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002 - the name of the base class
                del format, arguments

        try:
            self._server = _BoundedHttpServer((bind, port), Answering)
        except OSError as error:
            raise InputError(f"--web-port {port}: {error.strerror}; choose another") from error
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Answers no more. The thread ends first: it would go on looking at anyone who gets the closed socket's number."""
        self._server.shutdown()
        self._server.server_close()


class _BoundedHttpServer(ThreadingHTTPServer):
    """So many connections at once and no more; who says nothing is sent away after a while."""

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
        del request, client_address  # a browser that went away is no event


def _name_of(host: str) -> str:
    """A header ``Host`` without its port."""
    found = _HOST.match(host)
    return found[0] if found else "localhost"


def _with_data(host: str, grpc_port: int) -> str:
    """The viewer's page, told where its data are: on the same machine."""
    return f"/?url=rerun%2Bhttp://{_name_of(host)}:{grpc_port}/proxy"


FIRST_OF_ITS_OWN = 9920
"""Port of Rerun's server at its own address, or the next free one."""
_MOST_AT_ONCE = 64
_LONGEST_HEAD = 16_384
_HEAD_SECONDS = 10.0
_PIECE = 1 << 16
_GUESSES = 20
_SECOND_VERSION = b"PRI * HTTP/2.0\r\n\r\n"
_REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_REQUEST = re.compile(rb"[A-Z]{1,20} /[!-~]* HTTP/1\.[01]")
_DROPPED = frozenset({b"connection", b"keep-alive", b"upgrade", b"http2-settings", b"proxy-connection"})
"""Of a request's headers: what would have the connection carry something else than this one request."""


def private_loopback() -> str:
    """An address of the loopback interface that no one guesses, where the system has more than one (Linux)."""
    for _ in range(_GUESSES):
        address = f"127.{1 + secrets.randbelow(254)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.bind((address, 0))
            return address
    return "127.0.0.1"


class DataProxy:
    """Listens at ``bind`` and ``port``, and hands on to ``behind`` what asks for it under a name of ours.

    ``names`` are those next to the machine's own. Raises InputError when the port is taken.
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
            if self._open <= _MOST_AT_ONCE:
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
        retained: list[bytes] = []
        found: dict[bytes, list[str]] = {b"host": [], b"origin": []}
        for line in lines:
            name, colon, value = line.partition(b":")
            if not colon or name != name.strip() or b"\n" in line or b"\r" in line or b"\0" in line:
                return None  # folded, or two lines for someone else
            if name.lower() in found:
                found[name.lower()].append(value.strip().decode("latin-1"))
            if name.lower() not in _DROPPED:
                retained.append(line)
        if _REQUEST.fullmatch(first) is None:
            return None
        if len(found[b"host"]) != 1 or not self._hosts.allow(found[b"host"][0]):
            return None
        if not all(map(self._is_ours, found[b"origin"])):
            return None
        return b"\r\n".join((first, *retained, b"Connection: close", b"", b""))

    def _is_ours(self, origin: str) -> bool:
        """Whether a page of this machine asks: the viewer's own stands at another port."""
        scheme, mark, host = origin.partition("://")
        return bool(mark) and scheme in ("http", "https") and self._hosts.allow(host)


async def _hand_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while piece := await reader.read(_PIECE):
            writer.write(piece)
            await writer.drain()
