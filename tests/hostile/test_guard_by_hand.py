"""Which requests the page's guard lets through, answers itself or refuses: each condition alone, without a network."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from safedpa.limits import limit
from safedpa_services.web import guard as module
from safedpa_services.web.guard import HEALTHY, Door, Guard
from safedpa_services.web.hosts import Hosts


class Page:
    """A guard before a page; which requests reached it, what was sent to whoever asked, and what was told."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, password: str = "") -> None:
        self.events: list[str] = []
        monkeypatch.setattr(module, "log_event", lambda kind, *_, **__: self.events.append(kind))
        self.door = Door(Hosts("127.0.0.1"), 8080, token="a-token", password=password)
        self.seen: list[Any] = []
        self.sent: list[Any] = []

    async def _app(self, scope: Any, receive: Any, send: Any) -> None:
        self.seen.append(scope)
        if scope["type"] in ("http", "websocket"):
            while (message := await receive()).get("more_body"):
                self.seen.append(message)
            self.seen.append(message)
            await send({"type": "http.response.start", "status": 200, "headers": [(b"x-frame-options", b"DENY")]})

    def ask(
        self, body: tuple[bytes | str, ...] = (b"",), headers: tuple[tuple[bytes, bytes], ...] = (), **scope: Any
    ) -> int:
        """The status of the answer; 0 where there is none."""
        parts = list(body)

        async def receive() -> Any:
            if scope.get("type") == "websocket":
                part = parts.pop(0)
                return {"type": "websocket.receive", "text" if isinstance(part, str) else "bytes": part}
            return {"type": "http.request", "body": parts.pop(0), "more_body": bool(parts)}

        async def send(message: Any) -> None:
            self.sent.append(message)

        told = [(b"host", b"127.0.0.1:8080"), *headers]
        whole = {"type": "http", "method": "GET", "path": "/", "query_string": b"", "headers": told, **scope}
        asyncio.run(Guard(self._app, self.door)(whole, receive, send))
        return int(self.sent[0].get("status", 0)) if self.sent else 0


COOKIE = ((b"cookie", b"safedpa_8080=a-token"),)


@pytest.mark.parametrize("kind", ["lifespan", "http", "websocket"])
def test_only_what_is_no_request_passes_without_a_word(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    page = Page(monkeypatch)
    page.ask(type=kind)
    assert [scope["type"] for scope in page.seen] == (["lifespan"] if kind == "lifespan" else [])
    assert bool(page.events) is (kind != "lifespan")


@pytest.mark.parametrize(("kind", "path", "status"), [("http", HEALTHY, 204), ("http", "/", 401)])
def test_that_it_is_served_is_told_to_anybody_and_nothing_else(
    kind: str, path: str, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert Page(monkeypatch).ask(type=kind, path=path) == status


def test_a_socket_at_the_address_of_health_is_no_question_of_health(monkeypatch: pytest.MonkeyPatch) -> None:
    page = Page(monkeypatch)
    page.ask(type="websocket", path=HEALTHY)
    assert [message["type"] for message in page.sent] == ["websocket.close"]
    assert page.sent[0]["code"] == 1008


@pytest.mark.parametrize(
    ("password", "path", "asked", "status"),
    [
        ("", "/", b"", 401),
        ("sesame", "/", b"", 303),  # to the form
        ("", "/login", b"", 401),
        ("sesame", "/login", b"", 200),
        ("", "/", b"token=a-token", 303),  # to the page, with a cookie
        ("", "/", b"token=another", 401),
    ],
)
def test_without_a_cookie_the_form_is_shown_where_a_password_brings_one(
    password: str, path: str, asked: bytes, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = Page(monkeypatch, password)
    assert page.ask(path=path, query_string=asked) == status
    assert not page.seen


def test_who_may_not_ask_at_all_is_not_led_to_the_form(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page under another name is refused, whether or not a password could be given."""
    for password in ("", "sesame"):
        page = Page(monkeypatch, password)
        page.door = Door(Hosts("127.0.0.1"), 8080, token="a-token", password=password)
        assert page.ask(headers=((b"origin", b"http://elsewhere.example"),), method="POST") == 403
        assert not page.seen


@pytest.mark.parametrize("method", ["POST", "HEAD", "PUT"])
def test_a_token_in_the_address_is_good_for_opening_the_page_alone(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = Page(monkeypatch)
    assert page.ask(method=method, query_string=b"token=a-token") == 401
    socket = Page(monkeypatch)
    socket.ask(type="websocket", query_string=b"token=a-token")
    assert socket.sent[0]["type"] == "websocket.close"


@pytest.mark.parametrize(
    ("headers", "method", "status"),
    [
        ((), "GET", 200),
        (((b"origin", b"http://127.0.0.1:8080"),), "GET", 200),
        (((b"origin", b"http://127.0.0.1:8081"),), "GET", 403),
        (((b"origin", b"http://127.0.0.1:8080"),) * 2, "GET", 403),
        (((b"host", b"127.0.0.1:8080"),), "GET", 403),  # a second one
        (((b"sec-fetch-site", b"same-origin"),), "GET", 200),
        (((b"sec-fetch-site", b"none"),), "GET", 200),
        (((b"sec-fetch-site", b"cross-site"),), "GET", 403),
        (((b"sec-fetch-site", b"cross-site"), (b"sec-fetch-mode", b"navigate")), "GET", 200),  # a link
        (((b"sec-fetch-site", b"cross-site"), (b"sec-fetch-mode", b"navigate")), "POST", 403),  # a form
        (((b"sec-fetch-site", b"cross-site"), (b"sec-fetch-mode", b"no-cors")), "GET", 403),
    ],
)
def test_another_page_may_link_to_this_one_and_not_ask_it(
    headers: tuple[tuple[bytes, bytes], ...], method: str, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert Page(monkeypatch).ask(headers=(*COOKIE, *headers), method=method) == status


def test_another_page_opens_no_socket_even_by_what_looks_like_a_link(monkeypatch: pytest.MonkeyPatch) -> None:
    link = ((b"sec-fetch-site", b"cross-site"), (b"sec-fetch-mode", b"navigate"))
    page = Page(monkeypatch)
    page.ask(type="websocket", headers=(*COOKIE, *link))
    assert [message["type"] for message in page.sent] == ["websocket.close"]


@pytest.mark.parametrize(
    ("told", "more", "status"),
    [(None, 0, 200), (b"%d", 0, 200), (b"%d", 1, 413), (b"-1", 0, 413), (b"many", 0, 413), (b"", 0, 413)],
)
def test_a_body_is_as_long_as_it_may_be_by_what_is_told_of_it(
    told: bytes | None, more: int, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = limit("page_bytes")
    length = () if told is None else ((b"content-length", told % (most + more) if b"%" in told else told),)
    assert Page(monkeypatch).ask(headers=(*COOKIE, *length)) == status


@pytest.mark.parametrize(("over", "kind"), [(0, "http.request"), (1, "http.disconnect")])
def test_a_body_is_as_long_as_it_may_be_by_what_comes(over: int, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In several parts: all of them together count."""
    half = limit("page_bytes") // 2
    page = Page(monkeypatch)
    page.ask((bytes(half), bytes(limit("page_bytes") - half + over)), COOKIE)
    assert page.seen[-1]["type"] == kind
    assert page.events == ["page.refused"] * over


@pytest.mark.parametrize(("over", "kind"), [(0, "websocket.receive"), (1, "websocket.disconnect")])
def test_of_a_socket_each_message_is_as_long_as_it_may_be(
    over: int, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = Page(monkeypatch)
    page.ask((bytes(limit("socket_bytes") + over),), (*COOKIE, (b"content-length", b"99999999999")), type="websocket")
    assert page.seen[-1]["type"] == kind


@pytest.mark.parametrize("letter", ["a", "ä"])
@pytest.mark.parametrize(("over", "kind"), [(0, "websocket.receive"), (1, "websocket.disconnect")])
def test_words_on_a_socket_are_as_long_as_bytes_may_be(
    letter: str, over: int, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A browser sends words, not bytes; what counts is what they take in UTF-8 (RFC 6455, 5.6)."""
    page = Page(monkeypatch)
    letters = limit("socket_bytes") // len(letter.encode()) + over
    page.ask((letter * letters,), COOKIE, type="websocket")
    assert page.seen[-1]["type"] == kind
    assert page.events == ["page.refused"] * over


@pytest.mark.parametrize("path", ["/", "/login"])
def test_a_socket_is_no_form_for_a_password(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    page = Page(monkeypatch, "sesame")
    page.ask((b"password=sesame",), type="websocket", path=path)
    assert [(message["type"], message.get("code")) for message in page.sent] == [("websocket.close", 1008)]


@pytest.mark.parametrize(
    ("client", "told"), [(("192.0.2.7", 40123), "192.0.2.7"), (("2001:db8::7", 1, 0, 0), "2001:db8::7"), (None, "?")]
)
def test_who_was_refused_is_told_by_his_address(client: Any, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever reads the log wants to know whom to lock out; of a pipe there is no address."""
    page, sentences = Page(monkeypatch), list[str]()
    monkeypatch.setattr(module, "log_event", lambda _kind, sentence, **_: sentences.append(sentence))
    assert page.ask(client=client) == 401
    assert [sentence.rpartition(" ")[2] for sentence in sentences] == [told]


@pytest.mark.parametrize(
    ("kind", "method", "path", "most"),
    [
        ("websocket", "GET", "/", "socket_bytes"),
        ("http", "POST", "/_nicegui/client/7/upload", "upload_bytes"),
        ("http", "GET", "/_nicegui/client/7/upload", "page_bytes"),
        ("http", "POST", "/other", "page_bytes"),
        ("http", "POST", "/_nicegui_ws/socket.io", "socket_bytes"),
    ],
)
def test_an_upload_may_be_longer_than_what_else_is_asked(kind: str, method: str, path: str, most: str) -> None:
    assert Guard._most({"type": kind, "method": method, "path": path}) == limit(most)


def test_what_the_page_says_of_frames_itself_stands_and_the_rest_is_added(monkeypatch: pytest.MonkeyPatch) -> None:
    page = Page(monkeypatch)
    page.ask(headers=COOKIE)
    headers = {name.lower(): value for name, value in page.sent[0]["headers"]}
    assert headers[b"x-frame-options"] == b"DENY"
    assert headers[b"x-content-type-options"] == b"nosniff"
    assert b"ws://127.0.0.1:8080" in headers[b"content-security-policy"]


def test_a_wrong_password_takes_a_second_whoever_gives_it(monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []

    async def sleep(seconds: float) -> None:
        slept.append(seconds)

    monkeypatch.setattr(module.asyncio, "sleep", sleep)
    page = Page(monkeypatch, "sesame")
    assert page.ask((b"password=wrong",), method="POST", path="/login") == 401
    assert 0.5 <= slept[0] <= 2.0
    assert len(slept) == 1
    right = Page(monkeypatch, "sesame")
    assert right.ask((b"password=sesame",), method="POST", path="/login") == 303
    assert len(slept) == 1
