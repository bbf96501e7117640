"""The page that asks for a password: opening it is no try, a wrong word lets nobody in, and the right one does."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from safedpa_services.web import guard
from safedpa_services.web.guard import Door, Guard
from safedpa_services.web.hosts import Hosts

PASSWORD = "open, sesame"


class Page:
    """A guard before a page that must not be reached, asked without a network."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.events: list[str] = []
        monkeypatch.setattr(guard, "log_event", lambda kind, *_, **__: self.events.append(kind))
        monkeypatch.setattr(guard, "_WRONG_PASSWORD_SECONDS", 0.01)
        self.door = Door(Hosts("127.0.0.1"), 8080, password=PASSWORD)
        self.guard = Guard(self._never, self.door)

    async def _never(self, *_: Any) -> None:
        raise AssertionError("the page's framework saw a request without a token")

    def ask(self, method: str, path: str = "/login", body: bytes = b"") -> tuple[int, dict[str, str], bytes]:
        sent: list[dict[str, Any]] = []

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": body, "more_body": False}

        async def send(message: Any) -> None:
            sent.append(message)

        scope = {
            "type": "http", "method": method, "path": path, "query_string": b"",
            "headers": [(b"host", b"127.0.0.1:8080")], "client": ("127.0.0.1", 5),
        }  # fmt: skip
        asyncio.run(self.guard(scope, receive, send))
        headers = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
        return sent[0]["status"], headers, b"".join(part.get("body", b"") for part in sent[1:])


@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_opening_the_page_shows_the_form_and_is_no_try(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    """A browser that opens the page has given no wrong password: 200, and nobody is told of an attack."""
    page = Page(monkeypatch)
    status, headers, body = page.ask(method)
    assert status == 200
    assert b"type=password" in body
    assert "Set-Cookie" not in headers
    assert page.events == []


def test_even_the_right_word_in_what_is_no_form_brings_no_cookie(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only POST is a try: what a link or a prefetch sends changes nothing (RFC 9110, 9.2.1: GET is safe)."""
    status, headers, _ = Page(monkeypatch).ask("GET", body=b"password=open%2C+sesame")
    assert status == 200
    assert "Set-Cookie" not in headers


def test_a_wrong_word_is_refused_and_told_and_the_right_one_brings_the_cookie(monkeypatch: pytest.MonkeyPatch) -> None:
    page = Page(monkeypatch)
    status, headers, body = page.ask("POST", body=b"password=sesame")
    assert (status, page.events) == (401, ["page.wrong_password"])
    assert b"type=password" in body
    assert "Set-Cookie" not in headers
    status, headers, _ = page.ask("POST", body=b"password=open%2C+sesame")
    assert status in (200, 303)
    assert headers["Set-Cookie"].startswith(f"{page.door.cookie}={page.door.token};")
    assert page.events == ["page.wrong_password"]


def test_without_the_cookie_every_other_page_leads_to_the_form(monkeypatch: pytest.MonkeyPatch) -> None:
    status, headers, _ = Page(monkeypatch).ask("GET", "/live")
    assert (status, headers["Location"]) == (303, "/login")
