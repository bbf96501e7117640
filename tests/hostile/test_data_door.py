"""The viewer's data are given under the names of this machine, to pages of this machine, one request a connection."""

import contextlib
import ipaddress
import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safedpa.bus.transport.ports import free_port
from safedpa_services.dashboard.pages import DataProxy, ViewerServer, private_loopback

OWN = b"GET /proxy HTTP/1.1\r\nConnection: close\r\nHost: 127.0.0.1:9876\r\n\r\n"


@pytest.fixture(scope="module")
def behind() -> Iterator[tuple[tuple[str, int], list[bytes]]]:
    """A server that says ``data`` to whatever it is asked, and what it heard."""
    heard: list[bytes] = []
    server = socket.create_server((private_loopback(), 0))

    def answer(link: socket.socket) -> None:
        with link:
            heard.append(link.recv(65_536))
            link.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 4\r\nConnection: close\r\n\r\ndata")

    def serve() -> None:
        while True:
            try:
                link, _ = server.accept()
            except OSError:
                return
            threading.Thread(target=answer, args=(link,), daemon=True).start()

    threading.Thread(target=serve, daemon=True).start()
    yield server.getsockname(), heard
    server.shutdown(socket.SHUT_RDWR)
    server.close()


@pytest.fixture(scope="module")
def door(behind: tuple[tuple[str, int], list[bytes]]) -> Iterator[tuple[DataProxy, int]]:
    port = free_port()  # one of the kernel's own choice may be another connection's by then
    found = DataProxy("127.0.0.1", port, behind[0], ("robots.example",))
    yield found, port
    found.close()


def notice(port: int, head: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", port), timeout=60.0) as link:
        link.sendall(head)
        answer = b""
        while piece := link.recv(65_536):
            answer += piece
    return answer


def test_the_data_are_given_under_our_names(door: tuple[DataProxy, int]) -> None:
    page = OWN.replace(b"\r\n\r\n", b"\r\nOrigin: http://127.0.0.1:9090\r\n\r\n")
    for head in (OWN, page, OWN.replace(b"127.0.0.1", b"localhost"), OWN.replace(b"127.0.0.1", b"robots.example")):
        assert notice(door[1], head).endswith(b"data")


@pytest.mark.parametrize(
    "head",
    [
        OWN.replace(b"127.0.0.1", b"evil.example"),
        OWN.replace(b"127.0.0.1", b"127.0.0.1.evil.example"),
        OWN.replace(b"Host: 127.0.0.1:9876\r\n", b""),
        OWN.replace(b"\r\n\r\n", b"\r\nHost: evil.example\r\n\r\n"),
        OWN.replace(b"Host:", b"Host :"),
        OWN.replace(b"Host:", b" Host:"),
        OWN.replace(b"\r\n\r\n", b"\r\nOrigin: http://evil.example\r\n\r\n"),
        OWN.replace(b"\r\n\r\n", b"\r\nOrigin: null\r\n\r\n"),
        OWN.replace(b"\r\n\r\n", b"\r\nOrigin: http://127.0.0.1:9090\r\norigin: http://evil.example\r\n\r\n"),
        OWN.replace(b"\r\n\r\n", b"\r\nX: a\rb\r\n\r\n"),
        OWN.replace(b"/proxy", b"http://evil.example/proxy"),
        b"CONNECT 127.0.0.1:22 HTTP/1.1\r\nHost: 127.0.0.1:9876\r\n\r\n",
    ],
)
def test_everything_else_is_refused_before_it_is_heard(door, behind, head):
    heard = len(behind[1])
    assert re.match(rb"HTTP/1.1 (400|403|404|405) ", notice(door[1], head))
    assert len(behind[1]) == heard


def test_what_follows_the_first_request_is_on_its_own(door, behind):
    """Rerun's server closes after the answer, and is not asked for another protocol."""
    upgrade = OWN.replace(
        b"\r\n\r\n", b"\r\nConnection: Upgrade, HTTP2-Settings\r\nUpgrade: h2c\r\nHTTP2-Settings: AAMA\r\n\r\n"
    )
    notice(door[1], upgrade)
    heard = behind[1][-1].lower()
    assert b"upgrade" not in heard
    assert b"http2" not in heard
    assert heard.count(b"connection: close") == 1


def test_a_viewer_that_is_installed_speaks_another_protocol(door: tuple[DataProxy, int]) -> None:
    assert notice(door[1], b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n").endswith(b"data")


def test_silent_clients_do_not_shut_out_a_user_of_the_same_address(door: tuple[DataProxy, int]) -> None:
    """The longest silent connections are closed in favour of new ones, also when they are opened again at once."""
    links = [socket.create_connection(("127.0.0.1", door[1]), timeout=60.0) for _ in range(90)]
    try:
        for _ in range(3):
            assert notice(door[1], OWN).endswith(b"data")
            links += [socket.create_connection(("127.0.0.1", door[1]), timeout=60.0) for _ in range(30)]
        assert links[0].recv(1) == b""
    finally:
        for link in links:
            link.close()


@pytest.mark.long
def test_who_says_nothing_for_ten_seconds_is_sent_away(door: tuple[DataProxy, int]) -> None:
    """From the door of the page as from that of the data; otherwise a few silent ones would keep everybody out."""
    page = ViewerServer("127.0.0.1", port := free_port(), door[1])
    began = time.monotonic()
    links = [socket.create_connection(("127.0.0.1", number), timeout=40.0) for number in (door[1], port)]
    try:
        assert [link.recv(1) for link in links] == [b"", b""]
        assert 5.0 <= time.monotonic() - began <= 30.0
    finally:
        for link in links:
            link.close()
        page.close()


@given(st.binary(max_size=300))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_request_passes_under_a_foreign_name(door, behind, found: bytes) -> None:
    heard = len(behind[1])
    for head in (found + b"\r\n\r\n", b"GET / HTTP/1.1\r\nHost: evil.example\r\n" + found + b"\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", door[1]), timeout=60.0) as link, contextlib.suppress(OSError):
            link.sendall(head)
            link.shutdown(socket.SHUT_WR)
            while link.recv(65_536):
                pass
    assert len(behind[1]) == heard


def test_rerun_s_own_server_is_where_no_page_looks(tmp_path: Path) -> None:
    addresses = {private_loopback() for _ in range(20)}
    assert len(addresses) > 15
    assert all(ipaddress.ip_address(address).is_loopback for address in addresses)
