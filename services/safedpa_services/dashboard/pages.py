"""The web servers of the dashboard: the viewer's page, and a proxy in front of Rerun's data server.

Rerun's data server answers requests for any host name. A foreign web page could make its own host name resolve to this
machine (DNS rebinding) and read the data. The proxy therefore checks the host name and the origin of each request
before it sends it to Rerun's server, which listens at a random loopback address. HTTP/2 without TLS is forwarded
unchecked: only the native viewer uses it, browsers cannot.

Rerun's server holds all data back, up to 400 MB of them, until its slowest client has read. The proxy therefore
measures how long clients make data wait, and the dashboard draws less often for as long as one does.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence

import httpx
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route

from safedpa_services.web.guard import HostGuard
from safedpa_services.web.hosts import Hosts
from safedpa_services.web.server import PageProtocol, PageServer
from safedpa_services.web.viewer import Viewer, viewer_file

FIRST_RERUN_PORT = 9920
"""First port to try for Rerun's data server at its private address."""
_CONNECT_SECONDS = 10.0
_SILENCE_SECONDS = 300.0
"""Time without data in both directions after which a native viewer is disconnected."""
_PROMPT_SECONDS = 0.02
"""A client that takes data within this time has read everything before."""
_CHUNK_BYTES = 1 << 16
_GUESSES = 20
_HTTP2_PREFACE = b"PRI * HTTP/2.0\r\n\r\n"
_DROPPED = frozenset(
    ("host", "connection", "keep-alive", "proxy-connection", "upgrade", "http2-settings", "transfer-encoding")
)
"""Headers that belong to one connection and are not forwarded."""


def private_loopback() -> str:
    """Returns a random address of the loopback interface; 127.0.0.1 on systems that have only that one."""
    for _ in range(_GUESSES):
        address = f"127.{1 + secrets.randbelow(254)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.bind((address, 0))
            return address
    return "127.0.0.1"


def _guarded(answer: Callable[[Request], Awaitable[Response]], methods: Sequence[str], hosts: Hosts) -> Starlette:
    routes = [Route("/{path:path}", answer, methods=methods)]
    return Starlette(routes=routes, middleware=[Middleware(HostGuard, hosts=hosts)])


class ViewerServer(PageServer):
    """Serves the viewer's page, and redirects a browser without a data address to the data at ``grpc_port``.

    The address of the page is thereby short, and works from other machines, too.
    """

    def __init__(self, bind: str, port: int, grpc_port: int, names: Sequence[str] = ()) -> None:
        self._grpc_port, self._viewer = grpc_port, Viewer()
        super().__init__(_guarded(self._page, ["GET"], Hosts(bind, names)), bind, port, "--web-port")

    async def _page(self, request: Request) -> Response:
        data = f"http://{Hosts.without_port(request.headers['host'])}:{self._grpc_port}"
        name = request.path_params["path"]
        if not name and "url" not in request.query_params:
            return RedirectResponse(f"/?url=rerun%2B{data}/proxy", 302)
        return await viewer_file(self._viewer, name, f" {data}")


class Readers:
    """Measures how long the slowest client has made data wait; ``lag`` may be read on any thread."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._spans: dict[object, tuple[float, float | None]] = {}
        """By client: time [s] since which each part had to wait, and when it took the last one; None: not yet."""

    @contextlib.contextmanager
    def sending(self, client: object) -> Iterator[None]:
        """Surrounds the sending of one part."""
        began = self._clock()
        since, _ = self._spans.get(client, (began, began))
        self._spans[client] = (since, None)
        try:
            yield
        except BaseException:  # the client has gone
            self.gone(client)
            raise
        now = self._clock()
        self._spans[client] = (since if now - began > _PROMPT_SECONDS else now, now)

    def gone(self, client: object) -> None:
        """Forgets a client."""
        self._spans.pop(client, None)

    @property
    def lag(self) -> float:
        """Time [s] for which the slowest client has made data wait; 0 if all read in time."""
        now = self._clock()
        spans = list(self._spans.values())
        return max(((now if until is None else until) - since for since, until in spans), default=0.0)


class DataProxy(PageServer):
    """Sends requests to Rerun's server at ``behind``; ``names`` are further allowed host names."""

    def __init__(
        self,
        bind: str,
        port: int,
        behind: tuple[str, int],
        names: Sequence[str] = (),
        readers: Readers | None = None,
    ) -> None:
        timeout = httpx.Timeout(None, connect=_CONNECT_SECONDS)
        limits = httpx.Limits(max_connections=None, max_keepalive_connections=0)
        self._client = httpx.AsyncClient(timeout=timeout, limits=limits, trust_env=False)
        self._behind = httpx.URL(f"http://{behind[0]}:{behind[1]}")
        self.readers = readers or Readers()
        app = _guarded(self._forward, ["GET", "POST", "OPTIONS"], Hosts(bind, names))
        protocol = type("DataProtocol", (_DataProtocol,), {"behind": behind, "readers": self.readers})
        super().__init__(app, bind, port, "--grpc-port", protocol)

    async def _forward(self, request: Request) -> Response:
        path, query = request.scope["raw_path"], request.scope["query_string"]
        target = self._behind.copy_with(raw_path=path + (b"?" + query if query else b""))
        headers = [(name, value) for name, value in request.headers.items() if name not in _DROPPED]
        body = None if request.method == "GET" else request.stream()
        asked = httpx.Request(request.method, target, headers=[*headers, ("connection", "close")], content=body)
        try:
            answer = await self._client.send(asked, stream=True)
        except (httpx.TransportError, ClientDisconnect) as error:
            return PlainTextResponse(f"Rerun's data server did not answer ({type(error).__name__})\n", 502)
        kept = {name: value for name, value in answer.headers.items() if name not in _DROPPED}
        return StreamingResponse(self._parts(answer), answer.status_code, kept)

    async def _parts(self, answer: httpx.Response) -> AsyncIterator[bytes]:
        try:
            with contextlib.suppress(httpx.TransportError):  # the server has ended
                async for part in answer.aiter_raw():
                    with self.readers.sending(answer):
                        yield part
        finally:
            self.readers.gone(answer)
            await answer.aclose()


class _DataProtocol(PageProtocol):
    """Forwards HTTP/2 to ``behind`` unread, and reads everything else."""

    behind: tuple[str, int]
    readers: Readers
    _first, _is_http1 = b"", False

    def data_received(self, data: bytes) -> None:
        self._first += data
        if self._is_http1 or not _HTTP2_PREFACE.startswith(self._first[: len(_HTTP2_PREFACE)]):
            first, self._first, self._is_http1 = self._first, b"", True
            super().data_received(first)
        elif len(self._first) >= len(_HTTP2_PREFACE):
            reader = asyncio.StreamReader(loop=self.loop)
            streams = asyncio.StreamReaderProtocol(reader, loop=self.loop)
            self.transport.set_protocol(streams)
            streams.connection_made(self.transport)
            reader.feed_data(self._first)
            self._set_deadline()
            writer = asyncio.StreamWriter(self.transport, streams, reader, self.loop)
            task = self.loop.create_task(self._tunnel(reader, writer))
            self.tasks.add(task)
            task.add_done_callback(self.tasks.discard)

    async def _tunnel(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        sink: asyncio.StreamWriter | None = None
        try:
            async with asyncio.timeout(_CONNECT_SECONDS) as silence:
                data, sink = await asyncio.open_connection(*self.behind)
                copies = (self._copy(reader, sink, silence), self._copy(data, writer, silence))
                await asyncio.wait([self.loop.create_task(one) for one in copies], return_when=asyncio.FIRST_COMPLETED)
        except (OSError, TimeoutError):
            pass  # closed by one side, or silent
        finally:
            self.connections.discard(self)
            for end in filter(None, (writer, sink)):
                self.readers.gone(end)
                end.transport.abort()  # also ends the copy in the other direction

    async def _copy(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, silence: asyncio.Timeout) -> None:
        with contextlib.suppress(OSError):
            while chunk := await reader.read(_CHUNK_BYTES):
                silence.reschedule(self.loop.time() + _SILENCE_SECONDS)
                writer.write(chunk)
                with self.readers.sending(writer):
                    await writer.drain()
