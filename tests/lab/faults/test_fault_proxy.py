"""The proxy between a process and its router: what passes, what waits, what is lost."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator

import pytest

from safedpa_lab.faults.conduct import CUT, HALF_OPEN, PASS, STALLED, Conduct, bursts, delayed, losing, slow
from safedpa_lab.faults.proxy import Proxy

DATA = (4).to_bytes(2, "little") + b"\x05\x03\x1d\x00"
SIGN_OF_LIFE = (1).to_bytes(2, "little") + b"\x04"
QUIET_SECONDS = 0.3
LONG_SECONDS = 30.0


class Echo:
    """A router that sends back whatever it hears."""

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address: tuple[str, int] = self._server.getsockname()
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._server.accept()
            except OSError:
                return
            threading.Thread(target=self._answer, args=(connection,), daemon=True).start()

    def _answer(self, connection: socket.socket) -> None:
        with connection:
            try:
                while heard := connection.recv(4096):
                    connection.sendall(heard)
            except OSError:
                return

    def close(self) -> None:
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()


@pytest.fixture
def proxy() -> Iterator[Proxy]:
    echo = Echo()
    with Proxy(echo.address, ("a", "b"), seed=3) as opened:
        yield opened
    echo.close()


def joined(proxy: Proxy, name: str = "a") -> socket.socket:
    return socket.create_connection(("127.0.0.1", proxy.ports[name]), timeout=LONG_SECONDS)


def heard(connection: socket.socket, size: int) -> bytes:
    found = b""
    while len(found) < size:
        chunk = connection.recv(size - len(found))
        assert chunk, "the connection ended"
        found += chunk
    return found


def is_quiet(connection: socket.socket) -> bool:
    connection.settimeout(QUIET_SECONDS)
    try:
        return connection.recv(1) == b""
    except TimeoutError:
        return True
    finally:
        connection.settimeout(LONG_SECONDS)


def test_an_undisturbed_link_passes_everything_in_order(proxy: Proxy) -> None:
    with joined(proxy) as connection:
        sent = DATA * 500 + SIGN_OF_LIFE
        connection.sendall(sent)
        assert heard(connection, len(sent)) == sent
    assert proxy.endpoint("a") == f"tcp/127.0.0.1:{proxy.ports['a']}"


@pytest.mark.parametrize("conduct", [STALLED, HALF_OPEN, Conduct(stalled_in=True)])
def test_a_stalled_link_delivers_later_what_waited(proxy: Proxy, conduct: Conduct) -> None:
    with joined(proxy) as connection, joined(proxy, "b") as other:
        proxy.set("a", conduct)
        connection.sendall(DATA)
        other.sendall(DATA)
        assert heard(other, len(DATA)) == DATA, "the other link knows nothing of it"
        assert is_quiet(connection)
        proxy.set("a", PASS)
        assert heard(connection, len(DATA)) == DATA


def is_reset(connection: socket.socket) -> bool:
    try:
        connection.sendall(DATA)
        return connection.recv(1) == b""
    except ConnectionError:
        return True


def test_a_link_that_is_cut_ends_its_connections_and_refuses_new_ones(proxy: Proxy) -> None:
    with joined(proxy) as connection:
        connection.sendall(DATA)
        heard(connection, len(DATA))
        proxy.set("a", CUT)
        assert is_reset(connection)
    with joined(proxy) as refused:
        assert is_reset(refused)
    proxy.set("a", PASS)
    with joined(proxy) as connection:
        connection.sendall(DATA)
        assert heard(connection, len(DATA)) == DATA


def test_loss_takes_whole_batches_of_data_and_nothing_else(proxy: Proxy) -> None:
    proxy.set("a", losing(0.3))
    with joined(proxy) as connection:
        connection.sendall((DATA + SIGN_OF_LIFE) * 1000 + b"\x02\x00\x04\x07")
        found = b""
        while not found.endswith(b"\x02\x00\x04\x07"):
            found += connection.recv(4096)
    assert found.count(SIGN_OF_LIFE) == 1000
    kept = found.count(DATA)
    assert kept == 1000 - proxy.lost("a")
    assert 400 < kept < 580, "0.7 of 0.7 of them"


@pytest.mark.parametrize(
    ("conduct", "seconds"), [(delayed(0.2), 0.4), (bursts(0.4, 0.5), 0.35), (slow(len(DATA) / 0.2), 0.15)]
)
def test_what_is_slow_arrives_late_and_whole(proxy: Proxy, conduct: Conduct, seconds: float) -> None:
    with joined(proxy) as connection:
        connection.sendall(DATA)
        heard(connection, len(DATA))
        proxy.set("a", conduct)
        begin, turns = time.monotonic(), [0.0]
        while max(turns) < seconds and time.monotonic() < begin + LONG_SECONDS:
            sent = time.monotonic()
            connection.sendall(DATA)
            assert heard(connection, len(DATA)) == DATA
            turns.append(time.monotonic() - sent)
    assert max(turns) >= seconds
