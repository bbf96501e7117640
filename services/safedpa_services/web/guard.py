"""Stands before every page and socket: names, origins, the token of this run, sizes, and what browsers must refuse.

The token is part of the address that is printed. Anyone who opens it gets it as a cookie, which no script can read and
which the browser sends to this page alone; everything else is refused before the page's framework sees it.
"""

from __future__ import annotations

import asyncio
import hmac
import html
import secrets
import urllib.parse
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from typing import Any

from safedpa.bus.logging import log_event
from safedpa.limits import limit
from safedpa_services.web.hosts import Hosts

__all__ = ["AccessPolicy", "Guard"]

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

HEALTHY = "/healthy"
"""Answers without a token that the page is served; says nothing else."""
_LOGIN = "/login"
_UPLOAD = "/_nicegui/client/"
_WRONG_PASSWORD_SECONDS = 1.0
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}
_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' ws://{host} wss://{host}; "
    "object-src 'none'; base-uri 'self'; form-action 'self'; frame-ancestors 'self'"
)
"""The page's framework compiles its templates in the browser, hence the two words for scripts; nothing is loaded from,
or sent to, any other host."""


@dataclass(frozen=True)
class AccessPolicy:
    """Who comes in: under which names, with which token, and whether a password brings it."""

    hosts: Hosts
    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    password: str = ""
    scheme: str = "http"

    @property
    def cookie(self) -> str:
        """Its name: cookies do not tell ports apart."""
        return f"safedpa_{self.port}"

    def address(self, host: str, path: str) -> str:
        """What a person opens."""
        asked = "" if self.password else f"?token={self.token}"
        return f"{self.scheme}://{host}:{self.port}{path}{asked}"


class Guard:
    """An ASGI middleware."""

    def __init__(self, app: App, door: AccessPolicy) -> None:
        self._app, self._door = app, door
        self._one_at_a_time = asyncio.Lock()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Lets a request through, or answers it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = _headers(scope)
        reason = self._foreign(scope, headers)
        if reason:
            await self._refuse(scope, send, 403, reason)
        elif scope["type"] == "http" and scope["path"] == HEALTHY:
            await _answer(send, 204, b"")
        elif scope["type"] == "http" and scope["path"] == _LOGIN and self._door.password:
            await self._log_in(scope, receive, send)
        elif _same(self._asked(scope), self._door.token) and scope["type"] == "http" and scope["method"] == "GET":
            await self._give_cookie(scope, send)
        elif not _same(self._shown(headers), self._door.token):
            await self._refuse(scope, send, 401, "open the address that was printed when this page was started")
        else:
            await self._let_through(scope, receive, send, headers)

    def _foreign(self, scope: Scope, headers: dict[str, list[str]]) -> str:
        """Why a request is not from a page of our own; empty where it is."""
        hosts, origins = headers.get("host", []), headers.get("origin", [])
        if len(hosts) != 1 or not self._door.hosts.allow(hosts[0]):
            return "this page is not served under that name; name it with --name"
        if len(origins) > 1 or (origins and not self._door.hosts.same_origin(origins[0], hosts[0], self._door.scheme)):
            return "another page may not ask this one"
        site = headers.get("sec-fetch-site", ["none"])[0]
        navigates = scope["type"] == "http" and headers.get("sec-fetch-mode") == ["navigate"]
        if site not in ("none", "same-origin") and not (navigates and scope["method"] == "GET"):
            return "another page may not ask this one"
        return ""

    @staticmethod
    def _asked(scope: Scope) -> str:
        """The token in the address."""
        return dict(_fields(bytes(scope.get("query_string", b"")))).get("token", "")

    def _shown(self, headers: dict[str, list[str]]) -> str:
        """The token in the cookie."""
        try:
            jar = SimpleCookie("; ".join(headers.get("cookie", []))[:8192])
        except CookieError:
            return ""
        return str(jar[self._door.cookie].value) if self._door.cookie in jar else ""

    async def _give_cookie(self, scope: Scope, send: Send) -> None:
        query = _fields(scope["query_string"])
        rest = urllib.parse.urlencode([(name, value) for name, value in query if name != "token"])
        path = "/" + urllib.parse.quote(scope["path"].lstrip("/\\")) + (f"?{rest}" if rest else "")
        by_a_link = _headers(scope).get("sec-fetch-site", ["none"])[0] not in ("none", "same-origin")
        await self._redirect(send, path, by_a_link=by_a_link)

    async def _redirect(self, send: Send, path: str, *, by_a_link: bool = False) -> None:
        """``by_a_link``: the browser keeps the cookie back as long as it follows a link of another page."""
        secure = "; Secure" if self._door.scheme == "https" else ""
        cookie = f"{self._door.cookie}={self._door.token}; HttpOnly; SameSite=Strict; Path=/{secure}"
        headers = {"Set-Cookie": cookie, "Cache-Control": "no-store"}
        if by_a_link:
            page = f'<meta http-equiv="refresh" content="0; url={html.escape(path)}">'.encode()
            await _answer(send, 200, page, {**headers, "Content-Type": "text/html; charset=utf-8"})
        else:
            await _answer(send, 303, b"", {**headers, "Location": path})

    async def _log_in(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One try a second, anyone who tries."""
        if scope["method"] != "POST":
            await _answer(send, 200, _FORM, {"Content-Type": "text/html; charset=utf-8"})
            return
        body = await _body(receive, 4096)
        given = dict(_fields(body, "utf-8")).get("password", "")
        async with self._one_at_a_time:
            if _same(given, self._door.password):
                await self._redirect(send, "/")
                return
            await asyncio.sleep(_WRONG_PASSWORD_SECONDS)
        log_event("page.wrong_password", "someone gave a wrong password", level="warning", service="workbench")
        await _answer(send, 401, _FORM, {"Content-Type": "text/html; charset=utf-8"})

    async def _refuse(self, scope: Scope, send: Send, code: int, reason: str) -> None:
        client = str((scope.get("client") or ("?",))[0])
        log_event("page.refused", f"{reason}: {client}", level="warning", service="workbench", code=code)
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": reason[:120]})
        elif code == 401 and self._door.password:
            await _answer(send, 303, b"", {"Location": _LOGIN})
        else:
            await _answer(send, code, f"{reason}\n".encode())

    async def _let_through(self, scope: Scope, receive: Receive, send: Send, headers: dict[str, list[str]]) -> None:
        most = self._most(scope)
        reported = headers.get("content-length", ["0"])[0]
        if scope["type"] == "http" and (not reported.isdecimal() or int(reported[:19]) > most):
            await self._refuse(scope, send, 413, f"wanted at most {most} bytes")
            return
        host = headers["host"][0]
        came = 0

        async def measured() -> Message:
            nonlocal came
            message = await receive()
            content = message.get("body") or message.get("bytes") or (message.get("text") or "").encode()
            came = came + len(content) if scope["type"] == "http" else len(content)
            if came > most:
                log_event("page.refused", f"more than {most} bytes", level="warning", service="workbench", code=413)
                return {"type": "http.disconnect"} if scope["type"] == "http" else {"type": "websocket.disconnect"}
            return message

        async def with_policy(message: Message) -> None:
            if message["type"] == "http.response.start":
                known = {name.lower() for name, _ in message["headers"]}
                added = {**_HEADERS, "Content-Security-Policy": _POLICY.format(host=host)}
                message["headers"] = [
                    *message["headers"],
                    *((n.encode(), v.encode()) for n, v in added.items() if n.lower().encode() not in known),
                ]
            await send(message)

        await self._app(scope, measured, with_policy)

    @staticmethod
    def _most(scope: Scope) -> int:
        if scope["type"] == "websocket":
            return limit("socket_bytes")
        uploads = scope["method"] == "POST" and scope["path"].startswith(_UPLOAD)
        return limit("upload_bytes") if uploads else limit("socket_bytes" if "_ws" in scope["path"] else "page_bytes")


_FORM = (
    b"<!doctype html><meta charset=utf-8><title>safedpa</title><form method=post action=/login>"
    b"<label>Password <input type=password name=password autofocus></label> <button>Open</button></form>"
)


def _same(given: str, wanted: str) -> bool:
    return hmac.compare_digest(given.encode(), wanted.encode())


def _headers(scope: Scope) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name, value in scope["headers"]:
        found.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
    return found


def _fields(query: bytes, encoding: str = "latin-1") -> list[tuple[str, str]]:
    """Of an address or a form; none where there are too many."""
    try:
        return urllib.parse.parse_qsl(query.decode(encoding, "replace")[:4096], max_num_fields=32)
    except ValueError:
        return []


async def _body(receive: Receive, most: int) -> bytes:
    body = b""
    while True:
        message = await receive()
        body += bytes(message.get("body", b""))
        if not message.get("more_body") or len(body) > most:
            return body[:most]


async def _answer(send: Send, code: int, body: bytes, headers: dict[str, str] | None = None) -> None:
    all_headers = {
        "Content-Type": "text/plain; charset=utf-8",
        "Content-Length": str(len(body)),
        "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; form-action 'self'",
        **_HEADERS,
        **(headers or {}),
    }
    await send(
        {
            "type": "http.response.start",
            "status": code,
            "headers": [(name.encode(), value.encode("latin-1")) for name, value in all_headers.items()],
        }
    )
    await send({"type": "http.response.body", "body": body})
