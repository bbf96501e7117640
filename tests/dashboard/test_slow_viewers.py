"""A viewer that reads slowly: how long it makes data wait is measured, and fewer frames are drawn meanwhile."""

import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from safedpa.bus import Message, ReceivedMessage, RejectedMessage, Topic
from safedpa.bus.transport.ports import free_port
from safedpa_services.dashboard.display_settings import DisplaySettings
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_services.dashboard.pages import DataProxy, Readers

PART = b"x" * 65_536


def test_the_lag_is_the_time_for_which_the_slowest_client_made_data_wait() -> None:
    now = [0.0]
    readers = Readers(lambda: now[0])
    for _ in range(5):
        with readers.sending("prompt"):
            now[0] += 0.001
        with readers.sending("slow"):
            now[0] += 1.0
    assert readers.lag == pytest.approx(5.004)
    with readers.sending("slow"):
        now[0] += 2.0
        assert readers.lag == pytest.approx(7.004), "also while it is sent something"
    with readers.sending("slow"):
        pass
    assert readers.lag == 0.0, "it has caught up"


def test_a_client_that_leaves_while_it_is_sent_something_does_not_lag() -> None:
    now = [0.0]
    readers = Readers(lambda: now[0])

    def leave() -> None:
        with readers.sending("gone"):
            now[0] += 9.0
            raise ConnectionError

    with pytest.raises(ConnectionError):
        leave()
    assert readers.lag == 0.0


@pytest.fixture
def behind() -> Iterator[tuple[str, int]]:
    """A data server that sends without an end."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer(link: socket.socket) -> None:
            try:
                link.recv(65_536)
                link.sendall(b"HTTP/1.1 200 OK\r\nconnection: close\r\n\r\n")
                while True:
                    link.sendall(PART)
            except OSError:
                link.close()

        def serve() -> None:
            try:
                while True:
                    threading.Thread(target=answer, args=(server.accept()[0],), daemon=True).start()
            except OSError:
                pass

        threading.Thread(target=serve, daemon=True).start()
        yield server.getsockname()
        server.shutdown(socket.SHUT_RDWR)


def _await(holds: Callable[[], bool]) -> None:
    until = time.monotonic() + 30.0
    while not holds():
        assert time.monotonic() < until
        time.sleep(0.02)


@pytest.mark.parametrize("request_line", [b"GET / HTTP/1.1", b"PRI * HTTP/2.0"], ids=["browser", "native viewer"])
def test_a_client_that_does_not_read_lags_until_it_leaves(behind: tuple[str, int], request_line: bytes) -> None:
    proxy = DataProxy("127.0.0.1", free_port(), behind)
    end = b"\r\n\r\nSM\r\n\r\n" if b"PRI" in request_line else b"\r\nhost: localhost\r\n\r\n"
    with socket.create_connection(("127.0.0.1", proxy.port)) as client:
        client.sendall(request_line + end)
        _await(lambda: proxy.readers.lag > 1.0)
    _await(lambda: proxy.readers.lag == 0.0)
    proxy.close()


def test_fewer_frames_are_drawn_while_a_viewer_lags_and_all_again_afterwards(
    look: DisplaySettings, drive: Callable[[int], Iterator[list[tuple[Topic, Message]]]]
) -> None:
    view, drawn = FleetView(look), {True: 0, False: 0}
    for k, messages in enumerate(drive(800)):
        lags, at = k < 200, 0.05 * k
        items: list[ReceivedMessage | RejectedMessage] = [
            ReceivedMessage(topic, "r1", message, b"", "key", at) for topic, message in messages
        ]
        frames = view.take(items, at, waited=1.0 if lags else -3.0)
        if k < 200 or k >= 600:
            drawn[lags] += sum(any(entry.path[-1] == "barrier" for entry in frame.entries) for frame in frames)
    assert drawn[True] < 0.2 * drawn[False]
    assert view.pace.factor == 1
