"""Ports for processes about to start: free, and never handed out twice."""

import socket
from pathlib import Path

import pytest

from safedpa.bus.transport.ports import free_port
from safedpa.errors import InputError


@pytest.fixture
def listener():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", free_port()))
        taken.listen()
        yield taken.getsockname()[1]


def test_a_port_that_is_taken_is_not_chosen(listener: int) -> None:
    assert free_port([listener]) != listener


def test_a_preferred_port_is_chosen_when_it_is_free() -> None:
    wanted = free_port()
    assert free_port([wanted]) == wanted


def test_no_port_is_handed_out_twice_and_each_can_be_listened_on() -> None:
    given = [free_port() for _ in range(200)]
    assert len(set(given)) == len(given)
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", given[-1]))
        listening.listen()


def system_reports(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The operating system's range of ports for outgoing connections, as its file says it."""
    monkeypatch.setattr(Path, "read_text", lambda self, **_: text)


def test_no_outgoing_connection_can_take_it(monkeypatch: pytest.MonkeyPatch) -> None:
    system_reports("25000\t60999\n", monkeypatch)
    assert all(20000 <= free_port() < 25000 for _ in range(50))


@pytest.mark.parametrize("text", ["1024 65535", "20500 60999", "", "none"])
def test_a_system_that_says_nothing_useful_still_gets_ports(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    system_reports(text, monkeypatch)
    given = {free_port() for _ in range(600)}
    assert len(given) == 600
    assert all(20000 <= port < 32768 for port in given)


def test_two_processes_look_in_different_places(monkeypatch: pytest.MonkeyPatch) -> None:
    given = {}
    for process in (1000, 1001):
        monkeypatch.setattr("os.getpid", lambda process=process: process)
        given[process] = {free_port() for _ in range(50)}
    assert not given[1000] & given[1001]


def test_an_error_says_that_there_is_no_free_port(monkeypatch: pytest.MonkeyPatch) -> None:
    def taken(self: socket.socket, address: object) -> None:
        raise OSError("address already in use")

    monkeypatch.setattr(socket.socket, "bind", taken)
    with pytest.raises(InputError, match="no TCP port is free"):
        free_port([8080])
