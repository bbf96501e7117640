"""Zenoh's byte stream in batches, and the proxy between a process and its router."""

import socket
import threading
import time
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa_lab.faults.proxy import (
    CUT,
    HALF_OPEN,
    PASS,
    STALLED,
    Batches,
    Conduct,
    Proxy,
    carries_data,
)

FRAME, FRAGMENT, KEEP_ALIVE, INIT = 0x05, 0x06, 0x04, 0x01
PUSH, REQUEST, RESPONSE, DECLARE, INTEREST, FINAL = 0x1D, 0x1C, 0x1B, 0x1E, 0x19, 0x1A


def batch(*body: int) -> bytes:
    return len(body).to_bytes(2, "little") + bytes(body)


@given(st.lists(st.binary(max_size=400)), st.lists(st.integers(1, 97)))
def test_however_the_stream_is_cut_the_same_batches_come_out(bodies: list[bytes], cuts: list[int]) -> None:
    whole = [len(body).to_bytes(2, "little") + body for body in bodies]
    stream, batches, found = b"".join(whole), Batches(), []
    for cut in cuts:
        found += batches.feed(stream[:cut])
        stream = stream[cut:]
    assert found + batches.feed(stream) == whole


@pytest.mark.parametrize("kind", [PUSH, REQUEST, RESPONSE])
@pytest.mark.parametrize(
    "before",
    [
        (FRAME, 0x03),
        (FRAME | 0x20, 0x83, 0x01),  # reliable, a sequence number of two bytes
        (FRAME | 0x80, 0x03, 0x31, 0x07),  # an extension that is a number: the priority
        (FRAME | 0x80, 0x03, 0xB1, 0x87, 0x01, 0x02),  # two extensions, the second without a body
        (FRAME | 0x80, 0x03, 0x45, 0x02, 0xFF, 0xFF),  # an extension of two bytes
    ],
)
def test_a_frame_of_data_is_recognised_behind_numbers_and_extensions(before: tuple[int, ...], kind: int) -> None:
    assert carries_data(batch(*before, kind, 0x00))
    assert carries_data(batch(*before, kind | 0xE0, 0x00)), "its flags do not matter"
    assert not carries_data(batch(*before, DECLARE, 0x00))


def test_what_a_session_is_made_of_is_never_lost() -> None:
    for body in ((), (KEEP_ALIVE,), (INIT, 0x09), (FRAME,), (FRAME, 0x80), (FRAME | 0x80, 0x01, 0x45, 0x7F)):
        assert not carries_data(batch(*body))
    for kind in (DECLARE, INTEREST, FINAL):
        assert not carries_data(batch(FRAME, 0x03, kind))
    assert carries_data(batch(FRAGMENT, 0x03, 0x00)), "a part of a large message"


@pytest.mark.parametrize("size", [1, 127, 128, 300])
@pytest.mark.parametrize("kind", [PUSH, DECLARE])
def test_data_is_recognised_behind_an_extension_of_many_bytes(size: int, kind: int) -> None:
    """The length is sent seven bits a byte, the lowest first: 300 is 0b0000010 and 0b0101100."""
    length = [size] if size < 128 else [0x80 | size % 128, size // 128]
    body = (FRAME | 0x80, 0x03, 0x45, *length, *[DECLARE if kind == PUSH else PUSH] * size, kind, 0x00)
    assert carries_data(batch(*body)) is (kind == PUSH)


DATA = (4).to_bytes(2, "little") + b"\x05\x03\x1d\x00"
SIGN_OF_LIFE = (1).to_bytes(2, "little") + b"\x04"
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
        connection.settimeout(0.3)
        with pytest.raises(TimeoutError):
            connection.recv(1)
        connection.settimeout(LONG_SECONDS)
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
    proxy.set("a", Conduct(loss=0.3))
    with joined(proxy) as connection:
        connection.sendall((DATA + SIGN_OF_LIFE) * 1000 + b"\x02\x00\x04\x07")
        found = b""
        while not found.endswith(b"\x02\x00\x04\x07"):
            found += connection.recv(4096)
    assert found.count(SIGN_OF_LIFE) == 1000
    retained = found.count(DATA)
    assert retained == 1000 - proxy.lost("a")
    assert 400 < retained < 580, "0.7 of 0.7 of them"


@pytest.mark.parametrize(
    ("conduct", "seconds"),
    [
        (Conduct(delay=0.2), 0.4),
        (Conduct(pause=0.4, pause_every=0.5), 0.35),
        (Conduct(bytes_per_second_in=len(DATA) / 0.2), 0.15),
    ],
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
