"""The web server of all pages: uvicorn with deadlines, and with limits per client that shut out no one.

A client that sends nothing, or its TLS handshake or request head a byte a second, is closed after ``HEAD_SECONDS``.
When a client has too many connections, its longest idle one is closed in favour of the new one. A user who shares an
address with such a client, as all users of one machine do, is therefore still served.
"""

from __future__ import annotations

import asyncio
import ipaddress
import os
import socket
import ssl
import threading
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from safedpa.errors import InputError

HEAD_SECONDS = 10.0
"""Time for a TLS handshake, and for the head of a request."""
_STALL_SECONDS = 60.0
"""Time in which a client has to read what was sent to it."""
_MOST_OF_ONE_CLIENT, _MOST_OF_ALL = 48, 256
"""Connections. A browser opens six for requests, and one for each tab."""
_LONGEST_HEAD = 16_384
_END_SECONDS = 1


def client_of(address: tuple[str, int] | None) -> str:
    """Returns what limits count as one client: an IPv4 address, or an IPv6 network of 64 bits."""
    host = address[0] if address else ""
    return str(ipaddress.ip_network((host.partition("%")[0], 64), strict=False)) if ":" in host else host


class PageProtocol(H11Protocol):
    """A connection, with a deadline whenever it is the client's turn."""

    _deadline: asyncio.TimerHandle | None = None
    _stalled: asyncio.TimerHandle | None = None
    _since = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Takes a connection; closes an idle one, which may be this one, if there are too many."""
        super().connection_made(transport)
        self._since = self.loop.time()
        _make_room(self.connections, self.client)
        self._set_deadline()

    def connection_lost(self, exc: Exception | None) -> None:
        """Ends the deadlines."""
        super().connection_lost(exc)
        for timer in filter(None, (self._deadline, self._stalled)):
            timer.cancel()

    def data_received(self, data: bytes) -> None:
        """Reads a part of a request."""
        super().data_received(data)
        self._set_deadline()

    def pause_writing(self) -> None:
        """Begins the time in which the client has to read."""
        super().pause_writing()
        self._stalled = self.loop.call_later(_STALL_SECONDS, self.abort)

    def resume_writing(self) -> None:
        """Ends that time."""
        super().resume_writing()
        if self._stalled is not None:
            self._stalled.cancel()

    @property
    def idle_since(self) -> float | None:
        """Time [s] since which the client owes a request or its body; None while it is answered, and for a socket."""
        return self._since if self._awaits_head or (self._is_http and self.cycle.more_body) else None

    @property
    def _is_http(self) -> bool:
        return self.transport.get_protocol() is self

    @property
    def _awaits_head(self) -> bool:
        return self._is_http and (self.cycle is None or self.cycle.response_complete)

    def abort(self) -> None:
        """Closes the connection at once."""
        if self._is_http:
            self.connections.discard(self)
            self.transport.abort()

    def _set_deadline(self) -> None:
        if not self._awaits_head and self._deadline is not None:
            self._deadline.cancel()
            self._deadline, self._since = None, self.loop.time()
        elif self._awaits_head and self._deadline is None:
            self._deadline = self.loop.call_later(HEAD_SECONDS, self.abort)


class _Handshake(asyncio.Protocol):
    """A connection whose TLS handshake is not complete; it counts like any other."""

    def __init__(self, page: PageProtocol, context: ssl.SSLContext) -> None:
        self._page, self._context, self._received = page, context, b""
        self.idle_since, self.client = page.loop.time(), None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.pause_reading()  # until the handshake's own protocol reads
        self.client, self.abort = transport.get_extra_info("peername")[:2], transport.abort
        self._page.connections.add(self)  # type: ignore[arg-type]
        _make_room(self._page.connections, self.client)
        self._task = self._page.loop.create_task(self._secure(transport))

    def data_received(self, data: bytes) -> None:
        self._received += data

    async def _secure(self, transport: asyncio.Transport) -> None:
        loop, page = self._page.loop, self._page
        try:
            secured = await loop.start_tls(
                transport, self, self._context, server_side=True, ssl_handshake_timeout=HEAD_SECONDS
            )
        except (OSError, ssl.SSLError):
            return
        finally:
            page.connections.discard(self)
        if secured is None:  # the client has gone
            return
        secured.set_protocol(page)
        page.connection_made(secured)
        if self._received:
            page.data_received(self._received)

    def shutdown(self) -> None:
        """Called by the server at its end."""
        self.abort()


def _make_room(connections: set[Any], client: tuple[str, int] | None) -> None:
    """Closes the longest idle connection of ``client`` if it has too many, or of all if there are too many."""
    own = [one for one in connections if client_of(one.client) == client_of(client)]
    for links, most in ((own, _MOST_OF_ONE_CLIENT), (connections, _MOST_OF_ALL)):
        if len(links) > most:
            idle = [one for one in links if getattr(one, "idle_since", None) is not None]
            min(idle, key=lambda one: one.idle_since).abort()
            return


class PageLoop(asyncio.SelectorEventLoop):
    """An event loop whose servers count and limit TLS handshakes like connections."""

    async def create_server(self, factory: Any, *arguments: Any, **options: Any) -> Any:  # type: ignore[override]
        """Starts a server like any event loop; the protocols that ``factory`` makes are ``PageProtocol``."""
        context = options.pop("ssl", None)
        make = factory if context is None else lambda: _Handshake(factory(_loop=self), context)
        return await super().create_server(make, *arguments, **options)


def server_options(protocol: type[PageProtocol] = PageProtocol) -> dict[str, Any]:
    """Returns the options of uvicorn that every page has."""
    return {
        "http": protocol,
        "loop": f"{__name__}:{PageLoop.__name__}",
        "h11_max_incomplete_event_size": _LONGEST_HEAD,
        "backlog": 256,  # so many are accepted in one turn, before room is made
        "server_header": False,
    }


class PageServer:
    """Serves an application at ``bind`` and ``port`` in a thread of its own.

    Raises InputError, which begins with ``option``, if the port is taken.
    """

    def __init__(
        self, app: ASGIApp, bind: str, port: int, option: str, protocol: type[PageProtocol] = PageProtocol
    ) -> None:
        family = socket.AF_INET6 if ":" in bind else socket.AF_INET
        try:
            listening = socket.create_server((bind, port), family=family)
        except (OSError, OverflowError) as error:
            reason = os.strerror(number) if (number := getattr(error, "errno", None)) else str(error)
            raise InputError(f"{option} {port}: cannot listen there ({reason}); choose another") from error
        self.port = int(listening.getsockname()[1])
        options = {**server_options(protocol), "log_config": None, "log_level": "error", "access_log": False}
        config = uvicorn.Config(app, lifespan="off", ws="none", timeout_graceful_shutdown=_END_SECONDS, **options)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([listening],), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the server and its connections."""
        self._server.should_exit = self._server.force_exit = True
        self._thread.join()
