"""Ports for the viewer, and the door: a short address that sends a browser to the viewer with all that it needs."""

from __future__ import annotations

import re
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from safedpa.errors import InputError

__all__ = ["Door", "choose_port", "viewer_address"]

_ATTEMPTS = 50
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


def viewer_address(host: str, viewer_port: int, grpc_port: int) -> str:
    """The address of the web viewer that shows what the server at ``grpc_port`` has; one host for both."""
    return f"http://{host}:{viewer_port}/?url=rerun%2Bhttp://{host}:{grpc_port}/proxy"


class Door:
    """Answers every request with a redirect to the viewer, under the host name by which the browser came.

    So the address to remember is short, and works from another machine as it does from this one.
    """

    def __init__(self, bind: str, port: int, viewer_port: int, grpc_port: int) -> None:
        class Redirect(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                named = _HOST.match(self.headers.get("Host", ""))
                self.send_response(302)
                self.send_header("Location", viewer_address(named[0] if named else "localhost", viewer_port, grpc_port))
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002 - the name of the base class
                del format, arguments

        try:
            self._server = ThreadingHTTPServer((bind, port), Redirect)
        except OSError as error:
            raise InputError(f"--web-port {port}: {error.strerror}; choose another") from error
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Answers no more. The thread ends first: it would go on looking at whoever gets the closed socket's number."""
        self._server.shutdown()
        self._server.server_close()
