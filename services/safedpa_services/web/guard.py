"""Access control for the web pages: host names, origins, the token of this run, request sizes and security headers.

The token is part of the printed address. The browser that opens it gets the token as a cookie, which scripts cannot
read and which is sent to this page only. All other requests are refused before they reach the web framework.
"""

from __future__ import annotations

import asyncio
import hmac
import html
import urllib.parse
from collections.abc import Mapping

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from safedpa.bus.logging import log_event
from safedpa.limits import limit
from safedpa_services.web.page_options import PageServerOptions

HEALTHY = "/healthy"
"""Path of the health check: answers without a token, and only that the page is served."""
_LOGIN = "/login"
_UPLOAD = "/_nicegui/client/"
_WRONG_PASSWORD_SECONDS = 1.0
_HOW_TO_OPEN = "open the address that was printed when this page was started"
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


class Guard:
    """ASGI middleware that lets authorised requests through and answers all others."""

    def __init__(self, app: ASGIApp, options: PageServerOptions) -> None:
        self._app, self._options = app, options
        self._one_at_a_time = asyncio.Lock()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on, or answers it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        reason = self._foreign(scope, headers)
        if reason:
            await self._refuse(scope, receive, send, 403, reason)
        elif scope["type"] == "http" and scope["path"] == HEALTHY:
            await _answer(204, b"")(scope, receive, send)
        elif scope["type"] == "http" and scope["path"] == _LOGIN and self._options.password:
            await (await self._log_in(scope, receive))(scope, receive, send)
        elif scope["type"] == "http" and scope["method"] == "GET" and _equal(_token_in(scope), self._options.token):
            await self._without_token(scope, headers)(scope, receive, send)
        elif not _equal(self._token_in_cookie(headers), self._options.token):
            await self._refuse(scope, receive, send, 401, _HOW_TO_OPEN)
        else:
            await self._let_through(scope, receive, send, headers)

    def _foreign(self, scope: Scope, headers: Headers) -> str:
        """Returns why a request does not come from our own page; empty if it does."""
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        if len(hosts) != 1 or not self._options.hosts.allow(hosts[0]):
            return "this page is not served under that host name; allow it with --name"
        own = [self._options.hosts.same_origin(origin, hosts[0], self._options.scheme) for origin in origins]
        if own not in ([], [True]):
            return "requests from other pages are not allowed"
        site = headers.get("sec-fetch-site", "none")
        navigates = scope["type"] == "http" and headers.getlist("sec-fetch-mode") == ["navigate"]
        if site not in ("none", "same-origin") and not (navigates and scope["method"] == "GET"):
            return "requests from other pages are not allowed"
        return ""

    def _token_in_cookie(self, headers: Headers) -> str:
        return cookie_parser("; ".join(headers.getlist("cookie"))[:8192]).get(self._cookie, "")

    @property
    def _cookie(self) -> str:
        """Name of the cookie. It contains the port, because browsers share cookies between ports."""
        return f"safedpa_{self._options.port}"

    def _without_token(self, scope: Scope, headers: Headers) -> Response:
        """Returns a redirection to the same page without the token in its address."""
        fields = [(name, value) for name, value in _fields(scope["query_string"]) if name != "token"]
        rest = f"?{urllib.parse.urlencode(fields)}" if fields else ""
        path = "/" + urllib.parse.quote(scope["path"].lstrip("/\\")) + rest
        by_a_link = headers.get("sec-fetch-site", "none") not in ("none", "same-origin")
        return self._redirection(path, by_a_link=by_a_link)

    def _redirection(self, path: str, *, by_a_link: bool = False) -> Response:
        """Returns a redirection that sets the cookie.

        ``by_a_link``: a browser that follows a link from another page withholds a SameSite=Strict cookie on a redirect,
        but not on a page that refreshes itself.
        """
        secure = "; Secure" if self._options.scheme == "https" else ""
        cookie = f"{self._cookie}={self._options.token}; HttpOnly; SameSite=Strict; Path=/{secure}"
        headers = {"Set-Cookie": cookie, "Cache-Control": "no-store"}
        if by_a_link:
            page = f'<meta http-equiv="refresh" content="0; url={html.escape(path)}">'.encode()
            return _answer(200, page, {**headers, **_HTML})
        return _answer(303, b"", {**headers, "Location": path})

    async def _log_in(self, scope: Scope, receive: Receive) -> Response:
        """Answers the login form. A wrong password delays all further attempts by one second."""
        if scope["method"] != "POST":
            return _answer(200, _FORM, _HTML)
        given = dict(_fields(await _body(receive, 4096), "utf-8")).get("password", "")
        async with self._one_at_a_time:
            if _equal(given, self._options.password):
                return self._redirection("/")
            await asyncio.sleep(_WRONG_PASSWORD_SECONDS)
        log_event("page.wrong_password", "a wrong password was entered", level="warning", service="workbench")
        return _answer(401, _FORM, _HTML)

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, code: int, reason: str) -> None:
        client = str((scope.get("client") or ("?",))[0])
        log_event("page.refused", f"{reason}: {client}", level="warning", service="workbench", code=code)
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": reason[:120]})
        elif code == 401 and self._options.password:
            await _answer(303, b"", {"Location": _LOGIN})(scope, receive, send)
        else:
            await _answer(code, f"{reason}\n".encode())(scope, receive, send)

    async def _let_through(self, scope: Scope, receive: Receive, send: Send, headers: Headers) -> None:
        most = self._size_limit(scope)
        declared = headers.get("content-length", "0")
        if scope["type"] == "http" and (not declared.isdecimal() or int(declared[:19]) > most):
            await self._refuse(scope, receive, send, 413, f"wanted at most {most} bytes")
            return
        policy = _POLICY.format(host=headers["host"])
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
                shown = MutableHeaders(scope=message)
                for name, value in {**_HEADERS, "Content-Security-Policy": policy}.items():
                    shown.setdefault(name, value)
            await send(message)

        await self._app(scope, measured, with_policy)

    @staticmethod
    def _size_limit(scope: Scope) -> int:
        if scope["type"] == "websocket":
            return limit("socket_bytes")
        uploads = scope["method"] == "POST" and scope["path"].startswith(_UPLOAD)
        return limit("upload_bytes") if uploads else limit("socket_bytes" if "_ws" in scope["path"] else "page_bytes")


_HTML = {"Content-Type": "text/html; charset=utf-8"}
_FORM = (
    b"<!doctype html><meta charset=utf-8><title>safedpa</title><form method=post action=/login>"
    b"<label>Password <input type=password name=password autofocus></label> <button>Open</button></form>"
)


def _equal(given: str, wanted: str) -> bool:
    return hmac.compare_digest(given.encode(), wanted.encode())


def _token_in(scope: Scope) -> str:
    """Returns the token in the address."""
    return dict(_fields(scope.get("query_string", b""))).get("token", "")


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


def _answer(code: int, body: bytes, headers: Mapping[str, str] | None = None) -> Response:
    own = {
        "Content-Type": "text/plain; charset=utf-8",
        "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; form-action 'self'",
    }
    return Response(body, code, {**own, **_HEADERS, **(headers or {})})
