"""Access control for the web pages: host names, origins, the token of this run, request sizes and security headers.

The token is part of the printed address. The browser that opens it gets the token as a cookie, which scripts cannot
read and which is sent to this page only. All other requests are refused before they reach the web framework.
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

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

HEALTHY = "/healthy"
"""Path of the health check: answers without a token, and only that the page is served."""
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
"""The web framework compiles its templates in the browser, which needs 'unsafe-inline' and 'unsafe-eval' for scripts.
Nothing is loaded from or sent to any other host."""


@dataclass(frozen=True)
class AccessPolicy:
    """Under which host names the page is served, with which token, and optionally a password to obtain it."""

    hosts: Hosts
    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    password: str = ""
    scheme: str = "http"

    @property
    def cookie(self) -> str:
        """Name of the cookie. It contains the port, because browsers share cookies between ports."""
        return f"safedpa_{self.port}"

    def address(self, host: str, path: str) -> str:
        """Returns the address that the user opens."""
        query = "" if self.password else f"?token={self.token}"
        return f"{self.scheme}://{host}:{self.port}{path}{query}"


class Guard:
    """ASGI middleware that lets authorised requests through and answers all others."""

    def __init__(self, app: App, policy: AccessPolicy) -> None:
        self._app, self._policy = app, policy
        self._one_at_a_time = asyncio.Lock()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on, or answers it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = _headers(scope)
        reason = self._foreign(scope, headers)
        if reason:
            await self._refuse(scope, send, 403, reason)
        elif scope["type"] == "http" and scope["path"] == HEALTHY:
            await _answer(send, 204, b"")
        elif scope["type"] == "http" and scope["path"] == _LOGIN and self._policy.password:
            await self._log_in(scope, receive, send)
        elif (
            _equal(self._token_in_query(scope), self._policy.token)
            and scope["type"] == "http"
            and scope["method"] == "GET"
        ):
            await self._give_cookie(scope, send)
        elif not _equal(self._token_in_cookie(headers), self._policy.token):
            await self._refuse(scope, send, 401, "open the address that was printed when this page was started")
        else:
            await self._let_through(scope, receive, send, headers)

    def _foreign(self, scope: Scope, headers: dict[str, list[str]]) -> str:
        """Returns why a request does not come from our own page; empty if it does."""
        hosts, origins = headers.get("host", []), headers.get("origin", [])
        if len(hosts) != 1 or not self._policy.hosts.allow(hosts[0]):
            return "this page is not served under that host name; allow it with --name"
        if len(origins) > 1 or (
            origins and not self._policy.hosts.same_origin(origins[0], hosts[0], self._policy.scheme)
        ):
            return "requests from other pages are not allowed"
        site = headers.get("sec-fetch-site", ["none"])[0]
        navigates = scope["type"] == "http" and headers.get("sec-fetch-mode") == ["navigate"]
        if site not in ("none", "same-origin") and not (navigates and scope["method"] == "GET"):
            return "requests from other pages are not allowed"
        return ""

    @staticmethod
    def _token_in_query(scope: Scope) -> str:
        """Returns the token in the address."""
        return dict(_fields(bytes(scope.get("query_string", b"")))).get("token", "")

    def _token_in_cookie(self, headers: dict[str, list[str]]) -> str:
        """Returns the token in the cookie."""
        try:
            jar = SimpleCookie("; ".join(headers.get("cookie", []))[:8192])
        except CookieError:
            return ""
        return str(jar[self._policy.cookie].value) if self._policy.cookie in jar else ""

    async def _give_cookie(self, scope: Scope, send: Send) -> None:
        query = _fields(scope["query_string"])
        rest = urllib.parse.urlencode([(name, value) for name, value in query if name != "token"])
        path = "/" + urllib.parse.quote(scope["path"].lstrip("/\\")) + (f"?{rest}" if rest else "")
        by_a_link = _headers(scope).get("sec-fetch-site", ["none"])[0] not in ("none", "same-origin")
        await self._redirect(send, path, by_a_link=by_a_link)

    async def _redirect(self, send: Send, path: str, *, by_a_link: bool = False) -> None:
        """Redirects and sets the cookie.

        ``by_a_link``: a browser that follows a link from another page withholds a SameSite=Strict cookie on a redirect,
        but not on a page that refreshes itself.
        """
        secure = "; Secure" if self._policy.scheme == "https" else ""
        cookie = f"{self._policy.cookie}={self._policy.token}; HttpOnly; SameSite=Strict; Path=/{secure}"
        headers = {"Set-Cookie": cookie, "Cache-Control": "no-store"}
        if by_a_link:
            page = f'<meta http-equiv="refresh" content="0; url={html.escape(path)}">'.encode()
            await _answer(send, 200, page, {**headers, "Content-Type": "text/html; charset=utf-8"})
        else:
            await _answer(send, 303, b"", {**headers, "Location": path})

    async def _log_in(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers the login form. A wrong password delays all further attempts by one second."""
        if scope["method"] != "POST":
            await _answer(send, 200, _FORM, {"Content-Type": "text/html; charset=utf-8"})
            return
        body = await _body(receive, 4096)
        given = dict(_fields(body, "utf-8")).get("password", "")
        async with self._one_at_a_time:
            if _equal(given, self._policy.password):
                await self._redirect(send, "/")
                return
            await asyncio.sleep(_WRONG_PASSWORD_SECONDS)
        log_event("page.wrong_password", "a wrong password was entered", level="warning", service="workbench")
        await _answer(send, 401, _FORM, {"Content-Type": "text/html; charset=utf-8"})

    async def _refuse(self, scope: Scope, send: Send, code: int, reason: str) -> None:
        client = str((scope.get("client") or ("?",))[0])
        log_event("page.refused", f"{reason}: {client}", level="warning", service="workbench", code=code)
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": reason[:120]})
        elif code == 401 and self._policy.password:
            await _answer(send, 303, b"", {"Location": _LOGIN})
        else:
            await _answer(send, code, f"{reason}\n".encode())

    async def _let_through(self, scope: Scope, receive: Receive, send: Send, headers: dict[str, list[str]]) -> None:
        most = self._size_limit(scope)
        declared = headers.get("content-length", ["0"])[0]
        if scope["type"] == "http" and (not declared.isdecimal() or int(declared[:19]) > most):
            await self._refuse(scope, send, 413, f"wanted at most {most} bytes")
            return
        host = headers["host"][0]
        received = 0

        async def measured() -> Message:
            nonlocal received
            message = await receive()
            content = message.get("body") or message.get("bytes") or (message.get("text") or "").encode()
            received = received + len(content) if scope["type"] == "http" else len(content)
            if received > most:
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
    def _size_limit(scope: Scope) -> int:
        if scope["type"] == "websocket":
            return limit("socket_bytes")
        uploads = scope["method"] == "POST" and scope["path"].startswith(_UPLOAD)
        return limit("upload_bytes") if uploads else limit("socket_bytes" if "_ws" in scope["path"] else "page_bytes")


_FORM = (
    b"<!doctype html><meta charset=utf-8><title>safedpa</title><form method=post action=/login>"
    b"<label>Password <input type=password name=password autofocus></label> <button>Open</button></form>"
)


def _equal(given: str, wanted: str) -> bool:
    return hmac.compare_digest(given.encode(), wanted.encode())


def _headers(scope: Scope) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name, value in scope["headers"]:
        found.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
    return found


def _fields(query: bytes, encoding: str = "latin-1") -> list[tuple[str, str]]:
    """Parses the fields of a query or a form; returns none if there are too many."""
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
