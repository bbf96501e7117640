"""Which requests the page's guard lets through, answers itself or refuses, without a network."""

import asyncio
from typing import Any

import pytest

from safedpa.limits import limit
from safedpa_services.web import guard
from safedpa_services.web.guard import HEALTHY, Guard
from safedpa_services.web.page_options import PageServerOptions

TOKEN, PASSWORD = "a-token-of-tests", "open, sesame"
COOKIE = ((b"cookie", b"safedpa_8080=a-token-of-tests"),)
FORM = ((b"content-type", b"application/x-www-form-urlencoded"),)
CLOSED = [("websocket.close", 1008)]


class Page:
    """A guard before a page: requests that reached the page, messages to the client, and events in the log."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, password: str = "") -> None:
        self.events: list[str] = []
        self.sentences: list[str] = []
        self.slept: list[float] = []

        def log(kind: str, sentence: str, **_: Any) -> None:
            self.events.append(kind)
            self.sentences.append(sentence)

        async def sleep(seconds: float) -> None:
            self.slept.append(seconds)

        monkeypatch.setattr(guard, "log_event", log)
        monkeypatch.setattr(asyncio, "sleep", sleep)
        self.door = PageServerOptions("127.0.0.1", 8080, token=TOKEN, password=password)
        self.seen: list[Any] = []
        self.sent: list[Any] = []

    async def _app(self, scope: Any, receive: Any, send: Any) -> None:
        self.seen.append(scope)
        if scope["type"] in ("http", "websocket"):
            while (message := await receive()).get("more_body"):
                self.seen.append(message)
            self.seen.append(message)
            await send({"type": "http.response.start", "status": 200, "headers": [(b"x-frame-options", b"DENY")]})

    def ask(self, body: tuple[bytes | str, ...] = (b"",), headers: tuple[tuple[bytes, bytes], ...] = (), **scope: Any):
        """The status of the answer; 0 where there is none."""
        parts = list(body)
        self.sent.clear()

        async def receive() -> Any:
            if scope.get("type") == "websocket":
                part = parts.pop(0)
                return {"type": "websocket.receive", "text" if isinstance(part, str) else "bytes": part}
            return {"type": "http.request", "body": parts.pop(0), "more_body": bool(parts)}

        async def send(message: Any) -> None:
            self.sent.append(message)

        shown = [(b"host", b"127.0.0.1:8080"), *headers]
        whole = {"type": "http", "method": "GET", "path": "/", "query_string": b"", "headers": shown, **scope}
        asyncio.run(Guard(self._app, self.door)(whole, receive, send))
        return int(self.sent[0].get("status", 0)) if self.sent else 0

    @property
    def headers(self) -> dict[str, str]:
        """Of the last answer."""
        return {name.decode().lower(): value.decode() for name, value in self.sent[0]["headers"]}

    @property
    def answer(self) -> bytes:
        return b"".join(part.get("body", b"") for part in self.sent[1:])

    @property
    def closed(self) -> list[tuple[str, int]]:
        return [(message["type"], message.get("code")) for message in self.sent]


@pytest.fixture
def page(monkeypatch: pytest.MonkeyPatch) -> Page:
    return Page(monkeypatch)


@pytest.fixture
def locked(monkeypatch: pytest.MonkeyPatch) -> Page:
    """With a password."""
    return Page(monkeypatch, PASSWORD)


@pytest.mark.parametrize("kind", ["lifespan", "http", "websocket"])
def test_only_the_server_s_own_events_pass_without_a_token(kind: str, page: Page) -> None:
    page.ask(type=kind)
    assert [scope["type"] for scope in page.seen] == (["lifespan"] if kind == "lifespan" else [])
    assert page.events == ([] if kind == "lifespan" else ["page.refused"])


def test_the_health_of_the_page_is_public_over_http_alone(page: Page) -> None:
    assert page.ask(path=HEALTHY) == 204
    page.ask(type="websocket", path=HEALTHY)
    assert page.closed == CLOSED


@pytest.mark.parametrize(
    ("password", "path", "query", "status", "location"),
    [
        ("", "/", b"", 401, ""),
        ("", "/login", b"", 401, ""),
        ("", "/", b"token=another", 401, ""),
        ("", "/live", b"token=a-token-of-tests&x=1", 303, "/live?x=1"),
        (PASSWORD, "/live", b"", 303, "/login"),
        (PASSWORD, "/login", b"", 200, ""),
    ],
)
def test_without_a_cookie_the_token_or_the_form_is_asked_for(password, path, query, status, location, monkeypatch):
    page = Page(monkeypatch, password)
    assert page.ask(path=path, query_string=query) == status
    assert page.headers.get("location", "") == location
    cookie = page.headers.get("set-cookie", "")
    assert cookie.startswith("safedpa_8080=a-token-of-tests; HttpOnly") is (b"a-token" in query)
    assert not page.seen


@pytest.mark.parametrize("method", ["POST", "HEAD", "PUT"])
def test_a_token_in_the_address_only_opens_the_page(method: str, page: Page) -> None:
    assert page.ask(method=method, query_string=b"token=a-token-of-tests") == 401
    page.ask(type="websocket", query_string=b"token=a-token-of-tests")
    assert page.closed == CLOSED


SITE, MODE, ORIGIN = b"sec-fetch-site", b"sec-fetch-mode", b"origin"


@pytest.mark.parametrize(
    ("headers", "method", "status"),
    [
        ((), "GET", 200),
        (((ORIGIN, b"http://127.0.0.1:8080"),), "GET", 200),
        (((ORIGIN, b"http://127.0.0.1:8081"),), "GET", 403),
        (((ORIGIN, b"http://127.0.0.1:8080"),) * 2, "GET", 403),
        (((b"host", b"127.0.0.1:8080"),), "GET", 403),  # a second one
        (((SITE, b"same-origin"),), "GET", 200),
        (((SITE, b"none"),), "GET", 200),
        (((SITE, b"cross-site"),), "GET", 403),
        (((SITE, b"cross-site"), (MODE, b"navigate")), "GET", 200),  # a link
        (((SITE, b"cross-site"), (MODE, b"navigate")), "POST", 403),  # a form
        (((SITE, b"cross-site"), (MODE, b"no-cors")), "GET", 403),
    ],
)
def test_another_page_may_link_to_this_one_and_not_ask_it(headers, method, status, page, locked):
    assert page.ask(headers=(*COOKIE, *headers), method=method) == status
    if status == 403:
        assert locked.ask(headers=headers, method=method) == 403, "it is not led to the form"


def test_another_page_opens_no_socket_even_with_the_headers_of_a_link(page: Page) -> None:
    page.ask(type="websocket", headers=(*COOKIE, (SITE, b"cross-site"), (MODE, b"navigate")))
    assert page.closed == CLOSED


@pytest.mark.parametrize(
    ("length", "status"), [(None, 200), ("most", 200), ("more", 413), ("-1", 413), ("many", 413), ("", 413)]
)
@pytest.mark.parametrize(
    ("method", "path", "name"),
    [
        ("GET", "/", "page_bytes"),
        ("POST", "/other", "page_bytes"),
        ("GET", "/_nicegui/client/7/upload", "page_bytes"),
        ("POST", "/_nicegui/client/7/upload", "upload_bytes"),
        ("POST", "/_nicegui_ws/socket.io", "socket_bytes"),
    ],
)
def test_a_body_that_declares_too_many_bytes_is_refused(method, path, name, length, status, page):
    """An upload may be longer than other requests."""
    sizes = {"most": str(limit(name)), "more": str(limit(name) + 1)}
    headers = () if length is None else ((b"content-length", sizes.get(length, length).encode()),)
    assert page.ask(method=method, path=path, headers=(*COOKIE, *headers)) == status


@pytest.mark.parametrize(("over", "kind"), [(0, "http.request"), (1, "http.disconnect")])
def test_a_body_that_becomes_too_long_is_cut_off(over: int, kind: str, page: Page) -> None:
    """All parts together count."""
    half = limit("page_bytes") // 2
    page.ask((bytes(half), bytes(limit("page_bytes") - half + over)), COOKIE)
    assert page.seen[-1]["type"] == kind
    assert page.events == ["page.refused"] * over


@pytest.mark.parametrize("letter", [b"\0", "a", "ä"])
@pytest.mark.parametrize(("over", "kind"), [(0, "websocket.receive"), (1, "websocket.disconnect")])
def test_each_message_of_a_socket_has_a_largest_size_in_utf_8(letter: bytes | str, over: int, kind: str, page: Page):
    """RFC 6455, 5.6. A header about the length of a body says nothing about it."""
    size = len(letter.encode()) if isinstance(letter, str) else 1
    message = letter * (limit("socket_bytes") // size + over)
    page.ask((message,), (*COOKIE, (b"content-length", b"99999999999")), type="websocket")
    assert page.seen[-1]["type"] == kind
    assert page.events == ["page.refused"] * over


@pytest.mark.parametrize(
    ("client", "shown"), [(("192.0.2.7", 40123), "192.0.2.7"), (("2001:db8::7", 1, 0, 0), "2001:db8::7"), (None, "?")]
)
def test_the_log_names_the_address_of_a_refused_client(client: Any, shown: str, page: Page) -> None:
    assert page.ask(client=client) == 401
    assert [sentence.rpartition(" ")[2] for sentence in page.sentences] == [shown]


def test_the_page_s_own_headers_are_kept_and_the_others_added(page: Page) -> None:
    page.ask(headers=COOKIE)
    assert page.headers["x-frame-options"] == "DENY"
    assert page.headers["x-content-type-options"] == "nosniff"
    assert "ws://127.0.0.1:8080" in page.headers["content-security-policy"]


# the password


@pytest.mark.parametrize(("method", "body"), [("GET", b""), ("HEAD", b""), ("GET", b"password=open%2C+sesame")])
def test_opening_the_form_is_no_try(method: str, body: bytes, locked: Page) -> None:
    """Only POST is a try: a link or a prefetch changes nothing (RFC 9110, 9.2.1: GET is safe)."""
    assert locked.ask((body,), method=method, path="/login") == 200
    assert b"type=password" in locked.answer
    assert "set-cookie" not in locked.headers
    assert (locked.events, locked.slept) == ([], [])


def test_a_wrong_password_takes_a_second_and_is_logged_and_the_right_one_brings_the_cookie(locked: Page) -> None:
    assert locked.ask((b"password=sesame",), FORM, method="POST", path="/login") == 401
    assert b"type=password" in locked.answer
    assert "set-cookie" not in locked.headers
    assert locked.events == ["page.wrong_password"]
    assert len(locked.slept) == 1
    assert 0.5 <= locked.slept[0] <= 2.0
    assert locked.ask((b"password=open%2C+sesame",), FORM, method="POST", path="/login") == 303
    assert locked.headers["set-cookie"].startswith("safedpa_8080=a-token-of-tests;")
    assert (len(locked.events), len(locked.slept)) == (1, 1)
    assert not locked.seen, "the page's framework sees no request without a token"


@pytest.mark.parametrize("path", ["/", "/login"])
def test_a_password_is_not_taken_over_a_socket(path: str, locked: Page) -> None:
    locked.ask((b"password=open%2C+sesame",), type="websocket", path=path)
    assert locked.closed == CLOSED
