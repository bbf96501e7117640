"""Ports for the viewer, and the door: a short address at which a browser gets the viewer with all that it needs."""

from __future__ import annotations

import contextlib
import re
import socket
import threading
from collections.abc import Mapping, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from safedpa.errors import InputError, SafedpaError
from safedpa_services.web.hosts import Hosts
from safedpa_services.web.viewer import VIEWER_POLICY, Viewer

__all__ = ["Door", "choose_port"]

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
    """The wanted port, or without a wish the first free one from ``first`` on.

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


def _is_free(port: int, bind: str) -> bool:
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    try:
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((bind, port))
    except OSError:
        return False
    return True


class Door:
    """Serves the viewer's program, and sends a browser that comes without an address of data to those of ``grpc_port``.

    So the address to remember is short, and works from another machine as it does from this one. Asked for under a
    name that nobody named it answers nothing: another page could have had its own name resolve to this machine.
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
            self._server = _Bounded((bind, port), Answering)
        except OSError as error:
            raise InputError(f"--web-port {port}: {error.strerror}; choose another") from error
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Answers no more. The thread ends first: it would go on looking at whoever gets the closed socket's number."""
        self._server.shutdown()
        self._server.server_close()


class _Bounded(ThreadingHTTPServer):
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
