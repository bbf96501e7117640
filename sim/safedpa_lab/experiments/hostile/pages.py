"""The pages' own handlers as targets: no request without the token gets through, no name leads outside."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safedpa_lab.experiments.hostile.targets import Target
from safedpa_services.router.refusals import Refusals
from safedpa_services.web.guard import AccessPolicy, Guard
from safedpa_services.web.hosts import Hosts
from safedpa_services.web.upload_store import FileStore

_TOKEN = "a-token-that-cannot-be-guessed"
_GOOD = (
    b"GET / HTTP/1.1\nHost: 127.0.0.1:8080\nCookie: safedpa_8080=x\n",
    b"GET /?token=x HTTP/1.1\nHost: localhost\nSec-Fetch-Site: none\n",
    b"POST /_nicegui/client/a/upload/1 HTTP/1.1\nHost: 127.0.0.1:8080\nOrigin: http://127.0.0.1:8080\n"
    b"Content-Length: 12\nCookie: a=b; safedpa_8080=\n",
    b"WS /_nicegui_ws/socket.io/ HTTP/1.1\nHost: [::1]:8080\nOrigin: null\nSec-Fetch-Site: cross-site\n",
)
_LINES = (
    b"2026-01-01T00:00:00Z TRACE net-0 ThreadId(04) zenoh::net::routing::interceptor::access_control: aa on x is "
    b"unauthorized to Put (ingress) on safedpa/f/r1/action",
    b"2026-01-01T00:00:00Z TRACE net-0 ThreadId(04) zenoh::net::routing::interceptor: Msg intercepted!",
    b"2026-01-01T00:00:00Z WARN net-0 ThreadId(04) zenoh_link_tls::unicast: tls handshake eof. Hint: more",
)


@contextmanager
def page_targets() -> Iterator[tuple[Target, ...]]:
    """A guard with a page behind it, a shelf with files around it, the reader of the router's log."""
    with tempfile.TemporaryDirectory(prefix="safedpa-hostile-pages-") as name:
        yield (_guard(), _upload_store(Path(name).resolve()), _log())


def _guard() -> Target:
    async def page(scope: Any, receive: Any, send: Any) -> None:
        raise AssertionError("a request without the token got through")

    guard = Guard(page, AccessPolicy(Hosts("127.0.0.1"), 8080, _TOKEN))

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Any) -> None:
        if message["type"] == "http.response.start":
            for _, value in message["headers"]:
                if b"\n" in value or b"\r" in value:
                    raise AssertionError("a header of two lines")

    def read(data: bytes) -> None:
        first, *lines = data.split(b"\n")
        phrase = first.decode("latin-1").split(" ")
        path, _, query = (phrase[1] if len(phrase) > 1 else "/").partition("?")
        scope = {
            "type": "websocket" if phrase[0] == "WS" else "http",
            "method": phrase[0],
            "path": path,
            "query_string": query.encode("latin-1"),
            "headers": [(n.strip().lower(), v.strip()) for n, _, v in (line.partition(b":") for line in lines) if n],
            "client": ("127.0.0.1", 1),
        }
        asyncio.run(guard(scope, receive, send))

    return Target("page's guard", _GOOD, read, 0.1)


def _upload_store(folder: Path) -> Target:
    named, outside = folder / "named", folder / "outside"
    for place in (named, outside):
        place.mkdir()
        (place / "run.csv").write_text("t,x\n0,1\n", encoding="utf-8")
    (named / "link.csv").symlink_to(outside / "run.csv")
    (named / "way").symlink_to(outside)
    upload_store = FileStore([named])
    names = ("named/run.csv", "named/../outside/run.csv", "named/way/run.csv", "named/*.csv", "outside/run.csv")
    seeds = tuple(f"{folder}/{name}".encode() for name in names)

    def read(data: bytes) -> None:
        for found in upload_store.recordings(data.decode("utf-8", "replace").splitlines()):
            if not Path(found).resolve().is_relative_to(named):
                raise AssertionError(f"{found} was opened")

    return Target("page's files", seeds, read, 0.5)


def _log() -> Target:
    refusals = Refusals()
    return Target("router's log", _LINES, lambda data: refusals.hear(data.decode("utf-8", "replace")), 0.05)
