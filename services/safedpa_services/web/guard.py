"""Access control for the web pages: host names, origins, sizes and times of requests, tokens and security headers.

The token is part of the printed address. The browser that opens it gets the token as a cookie, which scripts cannot
read and which is sent to this page only. All other requests are refused before they reach the web framework.
"""

from __future__ import annotations

import asyncio
import hmac
import html
import urllib.parse
from collections import Counter
from typing import ClassVar

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request, cookie_parser
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from safedpa.bus.logging import log_event
from safedpa.limits import limit
from safedpa_services.web.hosts import Hosts
from safedpa_services.web.page_options import PageServerOptions
from safedpa_services.web.server import client_of

HEALTHY = "/healthy"
"""Path of the health check: answers without a token, and only that the page is served."""
_LOGIN = "/login"
_UPLOAD = "/_nicegui/client/"
_WRONG_PASSWORD_SECONDS, _MOST_ATTEMPTS = 1.0, 8
"""Each wrong password takes one of so many places of its client for this time."""
_BODY_SECONDS, _SLOWEST_BYTES_PER_SECOND = 20.0, 16_384
_HOW_TO_OPEN = "open the address that was printed when this page was started"
_FOREIGN_PAGE = "requests from other pages are not allowed"
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}
_ANSWER_POLICY = "default-src 'none'; style-src 'unsafe-inline'; form-action 'self'"
_PAGE_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' ws://{host} wss://{host}; "
    "object-src 'none'; base-uri 'self'; form-action 'self'; frame-ancestors 'self'"
)
"""The web framework compiles its templates in the browser, which needs 'unsafe-inline' and 'unsafe-eval' for scripts.
Nothing is loaded from or sent to any other host."""


class HostGuard:
    """ASGI middleware for a page without secrets: refuses other host names and pages, and bounds sizes and times."""

    headers: ClassVar[dict[str, str]] = {
        name: _HEADERS[name] for name in ("X-Content-Type-Options", "X-Frame-Options", "Referrer-Policy")
    }
    policy = _ANSWER_POLICY
    service = "dashboard"

    def __init__(self, app: ASGIApp, hosts: Hosts) -> None:
        self._app, self._hosts = app, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on, or answers it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        hosts = headers.getlist("host")
        reason = "this page is not served under that host name; allow it with --name"
        if len(hosts) == 1 and self._hosts.allow(hosts[0]):
            reason = "" if self._is_own_page(scope, headers, hosts[0]) else _FOREIGN_PAGE
        if reason:
            await self._refuse(scope, receive, send, 403, reason)
        else:
            await self._answer(scope, receive, send, headers)

    def _is_own_page(self, scope: Scope, headers: Headers, host: str) -> bool:
        """Returns whether a request comes from a page of this machine, at any port, or from no page."""
        origins = [origin.partition("://") for origin in headers.getlist("origin")]
        return all(scheme in ("http", "https") and self._hosts.allow(name) for scheme, _, name in origins)

    async def _answer(self, scope: Scope, receive: Receive, send: Send, headers: Headers) -> None:
        await self._let_through(scope, receive, send, headers)

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, code: int, reason: str) -> None:
        client = str((scope.get("client") or ("?",))[0])
        log_event("page.refused", f"{reason}: {client}", level="warning", service=self.service, code=code)
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": reason[:120]})
        else:
            await self._reply(PlainTextResponse(f"{reason}\n", code), scope, receive, send)

    async def _reply(self, response: Response, scope: Scope, receive: Receive, send: Send) -> None:
        """Sends an answer of our own."""
        for name, value in {**_HEADERS, "Content-Security-Policy": _ANSWER_POLICY}.items():
            response.headers.setdefault(name, value)
        await response(scope, receive, send)

    async def _let_through(self, scope: Scope, receive: Receive, send: Send, headers: Headers) -> None:
        most = self._size_limit(scope)
        declared = headers.get("content-length", "0")
        if scope["type"] == "http" and (not declared.isdecimal() or int(declared[:19]) > most):
            await self._refuse(scope, receive, send, 413, f"wanted at most {most} bytes")
            return
        policy = self.policy.format(host=headers["host"])

        async def with_policy(message: Message) -> None:
            if message["type"] == "http.response.start":
                shown = MutableHeaders(scope=message)
                for name, value in {**self.headers, "Content-Security-Policy": policy}.items():
                    shown.setdefault(name, value)
            await send(message)

        await self._app(scope, self._bounded(scope, receive, most), with_policy)

    def _bounded(self, scope: Scope, receive: Receive, most: int) -> Receive:
        """Returns a ``receive`` that ends a request whose body, or a socket whose message, is too long or too slow."""
        is_socket = scope["type"] == "websocket"
        began, received, complete = asyncio.get_running_loop().time(), 0, is_socket

        def cut_off(reason: str, code: int) -> Message:
            log_event("page.refused", reason, level="warning", service=self.service, code=code)
            return {"type": f"{scope['type']}.disconnect"}

        async def bounded() -> Message:
            nonlocal received, complete
            late = began + _BODY_SECONDS + received / _SLOWEST_BYTES_PER_SECOND
            try:
                async with asyncio.timeout_at(None if complete else late):
                    message = await receive()
            except TimeoutError:
                return cut_off(f"a body slower than {_SLOWEST_BYTES_PER_SECOND} bytes a second", 408)
            content = message.get("body") or message.get("bytes") or (message.get("text") or "").encode()
            received = len(content) if is_socket else received + len(content)
            complete = complete or not message.get("more_body")
            return message if received <= most else cut_off(f"more than {most} bytes", 413)

        return bounded

    def _size_limit(self, scope: Scope) -> int:
        return limit("page_bytes")


class Guard(HostGuard):
    """ASGI middleware that lets a page's own requests with the token through and answers all others."""

    headers, policy, service = _HEADERS, _PAGE_POLICY, "workbench"

    def __init__(self, app: ASGIApp, options: PageServerOptions) -> None:
        super().__init__(app, options.hosts)
        self._options, self._attempts = options, Counter[str]()

    def _is_own_page(self, scope: Scope, headers: Headers, host: str) -> bool:
        own = [self._hosts.same_origin(origin, host, self._options.scheme) for origin in headers.getlist("origin")]
        site = headers.get("sec-fetch-site", "none")
        navigates = scope["type"] == "http" and headers.getlist("sec-fetch-mode") == ["navigate"]
        by_link = navigates and scope["method"] == "GET"
        return own in ([], [True]) and (site in ("none", "same-origin") or by_link)

    async def _answer(self, scope: Scope, receive: Receive, send: Send, headers: Headers) -> None:
        if scope["type"] == "http":
            own = await self._own_answer(Request(scope, self._bounded(scope, receive, limit("page_bytes"))))
            if own is not None:
                await self._reply(own, scope, receive, send)
                return
        cookie = cookie_parser("; ".join(headers.getlist("cookie"))[:8192]).get(self._cookie, "")
        if _equal(cookie, self._options.token):
            await self._let_through(scope, receive, send, headers)
        elif scope["type"] == "http" and self._options.password:
            await self._reply(RedirectResponse(_LOGIN, 303), scope, receive, send)
        else:
            await self._refuse(scope, receive, send, 401, _HOW_TO_OPEN)

    async def _own_answer(self, request: Request) -> Response | None:
        """Returns the answer to requests that are not meant for the page."""
        path = request.scope["path"]
        if path == HEALTHY:
            return Response(status_code=204)
        if path == _LOGIN and self._options.password:
            return await self._log_in(request)
        if request.method == "GET" and _equal(request.query_params.get("token", ""), self._options.token):
            return self._without_token(request)
        return None

    @property
    def _cookie(self) -> str:
        """Name of the cookie. It contains the port, because browsers share cookies between ports."""
        return f"safedpa_{self._options.port}"

    def _without_token(self, request: Request) -> Response:
        """Returns a redirection to the same page without the token in its address."""
        fields = [(name, value) for name, value in request.query_params.multi_items() if name != "token"]
        rest = f"?{urllib.parse.urlencode(fields)}" if fields else ""
        path = "/" + urllib.parse.quote(request.scope["path"].lstrip("/\\")) + rest
        if request.headers.get("sec-fetch-site", "none") in ("none", "same-origin"):
            return self._with_cookie(RedirectResponse(path, 303))
        # a browser that follows a link from another page withholds a SameSite=Strict cookie on a redirect, but not on
        # a page that refreshes itself
        return self._with_cookie(HTMLResponse(f'<meta http-equiv="refresh" content="0; url={html.escape(path)}">'))

    def _with_cookie(self, response: Response) -> Response:
        secure = "; Secure" if self._options.scheme == "https" else ""
        cookie = f"{self._cookie}={self._options.token}; HttpOnly; SameSite=Strict; Path=/{secure}"
        response.headers.update({"Set-Cookie": cookie, "Cache-Control": "no-store"})
        return response

    async def _log_in(self, request: Request) -> Response:
        """Answers the login form. Wrong passwords delay further attempts of the same client only."""
        if request.method != "POST":
            return HTMLResponse(_FORM.format(result=""))
        try:
            given = str((await request.form(max_files=0, max_fields=8)).get("password", ""))
        except (ClientDisconnect, HTTPException):
            given = ""
        client = client_of(request.scope.get("client"))
        if self._attempts[client] >= _MOST_ATTEMPTS:
            return HTMLResponse(_FORM.format(result=_TOO_MANY), 429, {"Retry-After": "1"})
        if _equal(given, self._options.password):
            return self._with_cookie(RedirectResponse("/", 303))
        self._attempts[client] += 1
        await asyncio.sleep(_WRONG_PASSWORD_SECONDS)
        self._attempts -= Counter([client])
        log_event("page.wrong_password", "a wrong password was entered", level="warning", service=self.service)
        return HTMLResponse(_FORM.format(result="Wrong password."), 401)

    def _size_limit(self, scope: Scope) -> int:
        if scope["type"] == "websocket" or ("_ws" in scope["path"] and not scope["path"].startswith(_UPLOAD)):
            return limit("socket_bytes")
        uploads = scope["method"] == "POST" and scope["path"].startswith(_UPLOAD)
        return limit("upload_bytes" if uploads else "page_bytes")


_TOO_MANY = "Too many wrong passwords from your address; try again in a second."
_FORM = (
    "<!doctype html><meta charset=utf-8><title>safedpa</title><form method=post action=/login>"
    "<label>Password <input type=password name=password autofocus></label> <button>Open</button> {result}</form>"
)


def _equal(given: str, wanted: str) -> bool:
    return hmac.compare_digest(given.encode(), wanted.encode())
