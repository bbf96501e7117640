"""Who is cut off at the door and when, which descriptors are kept back, and which sockets are looked at."""

import json
import os
import resource
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from tests.waiting import until

from safedpa.bus.security.connection_reaper import (
    ConnectionReaper,
    cut_off,
    defer_accept,
    listening_ports,
    raise_descriptor_limit,
)

Address = tuple[str, int]


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


class Guest:
    """A connection: the guest's end and the one that was accepted."""

    def __init__(self, link: socket.socket, accepted: socket.socket) -> None:
        self.link, self.accepted = link, accepted

    @property
    def address(self) -> Address:
        host, port = self.link.getsockname()[:2]
        return host, port

    @property
    def is_cut_off(self) -> bool:
        self.link.settimeout(0.0)
        try:
            return self.link.recv(1) == b""
        except BlockingIOError:
            return False


class Door:
    """A listening socket with its keeper, on a clock that the test moves.

    A keeper that does not watch looks when ``look`` is called; ``looks`` counts all looks.
    """

    def __init__(self, host: str = "127.0.0.1", *, watches: bool = False) -> None:
        self.now, self.looks, self.inside = 100.0, 0, set[Address]()
        self.retained = ExitStack()
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.listening = self.retained.enter_context(socket.create_server((host, 0), family=family, backlog=200))
        self.address: Address = self.listening.getsockname()[:2]
        self.keeper = ConnectionReaper({self.address[1]}, self.members, lambda: self.now)
        self.retained.callback(self.keeper.close)
        if not watches:
            self.keeper.close()

    def members(self) -> set[Address]:
        self.looks += 1
        return self.inside

    def look(self) -> int:
        return self.keeper.check()

    def watched(self) -> bool:
        """After the keeper has looked at everything that is there now."""
        looks = self.looks
        return until(lambda: self.looks >= looks + 2)

    def enter(self, count: int = 1, *, members: bool = False) -> list[Guest]:
        guests = []
        for _ in range(count):
            link = self.retained.enter_context(socket.create_connection(self.address))
            guests.append(Guest(link, self.retained.enter_context(self.listening.accept()[0])))
        self.inside |= {guest.address for guest in guests} if members else set()
        return guests


@pytest.fixture(params=["127.0.0.1", "::1"])
def door(request: pytest.FixtureRequest) -> Iterator[Door]:
    try:
        found = Door(request.param)
    except OSError:
        pytest.skip("no IPv6 here")
    with found.retained:
        yield found


@pytest.fixture
def watched() -> Iterator[Door]:
    found = Door(watches=True)
    with found.retained:
        yield found


@pytest.mark.parametrize(
    ("count", "short", "patience"),
    [(1, False, 3.0), (32, False, 3.0), (33, False, 0.4), (1, True, 0.1), (33, True, 0.1)],
)
def test_a_stranger_has_three_seconds_and_less_among_many_or_where_no_descriptor_is_left(
    count: int, short: bool, patience: float, door: Door, monkeypatch: pytest.MonkeyPatch
) -> None:
    members, strangers = door.enter(40, members=True), door.enter(count)
    if short:
        monkeypatch.setattr(os, "dup", none_left)
    assert door.look() == 0
    door.now = 100.0 + 0.99 * patience
    assert door.look() == 0
    door.now = 100.0 + 1.01 * patience
    assert door.look() == count
    assert all(stranger.is_cut_off for stranger in strangers)
    assert not any(member.is_cut_off for member in members)


def none_left(descriptor: int) -> int:
    raise OSError(f"no copy of {descriptor}: Too many open files")


def test_a_stranger_that_became_a_member_or_got_the_number_of_another_is_not_cut_off(door: Door) -> None:
    first, second, third = door.enter(3)
    door.look()
    door.now += 2.0
    waiting = door.retained.enter_context(socket.create_connection(door.address))
    number = second.accepted.fileno()
    second.accepted.close()
    late = Guest(waiting, door.retained.enter_context(door.listening.accept()[0]))
    assert late.accepted.fileno() == number
    door.look()
    door.now += 1.5
    door.inside.add(third.address)
    assert (door.look(), first.is_cut_off) == (1, True)
    first.accepted.close()
    door.now += 1.4
    assert door.look() == 0, "2.9 s after it came"
    door.now += 0.2
    assert (door.look(), late.is_cut_off, third.is_cut_off) == (1, True, False)


def test_only_connections_to_the_guarded_port_are_cut_off(door: Door, tmp_path: Path) -> None:
    """Neither those that this process opened, nor those to its other ports, nor sockets in the file system."""
    other = Door()
    with other.retained, socket.socket(socket.AF_UNIX) as local, socket.socket(socket.AF_UNIX) as guest:
        local.bind(str(tmp_path / "bus"))
        local.listen()
        guest.connect(str(tmp_path / "bus"))
        (own,), (elsewhere,) = door.enter(), other.enter()
        door.look()
        door.now += 3.5
        assert door.look() == 1
        assert (own.is_cut_off, elsewhere.is_cut_off) == (True, False)
        guest.sendall(b"still here")
        with local.accept()[0] as accepted:
            assert accepted.recv(10) == b"still here"


def test_strangers_are_looked_for_ten_times_a_second_and_reported_once_a_second(watched, capsys):
    events: list[dict[str, object]] = []

    def reported() -> list[object]:
        events.extend(map(json.loads, capsys.readouterr().err.splitlines()))
        return [event["count"] for event in events]

    looks = watched.looks
    assert until(lambda: watched.looks >= looks + 10, 6.0)
    many = watched.enter(33)
    assert watched.watched()
    watched.now = 100.5
    assert until(lambda: all(guest.is_cut_off for guest in many))
    for guest in many:
        guest.accepted.close()
    assert watched.watched()
    assert reported() == [], "half a second after it began"
    watched.now = 101.1
    assert until(lambda: reported() == [33])
    (one,) = watched.enter()
    assert watched.watched()
    watched.now += 3.5
    assert until(lambda: one.is_cut_off)
    one.accepted.close()
    watched.now += 1.1
    assert until(lambda: reported() == [33, 1]), "each is counted once"
    assert {(event["kind"], event["level"]) for event in events} == {("bus.strangers_cut_off", "warning")}
    assert str(events[0]["sentence"]).startswith("closed 33 connections")


@pytest.mark.parametrize(("limit", "wanted"), [(6_000, 160), (960, 160), (600, 100), (605, 100)])
def test_a_sixth_of_all_descriptors_is_kept_back_and_160_at_most(limit, wanted, monkeypatch):
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit, 10 * limit))
    before = descriptors()
    keeper = ConnectionReaper({1}, tuple)
    assert descriptors() - before == wanted
    time.sleep(0.25)  # some looks
    assert descriptors() - before == wanted, "no more are taken, and none is left open"
    keeper.close()
    assert descriptors() == before


def test_where_no_descriptor_is_left_those_kept_back_are_released_and_taken_again(watched, monkeypatch):
    """Meanwhile the process can accept connections, and close those that were cut off."""
    before = descriptors()
    monkeypatch.setattr(os, "dup", none_left)
    assert until(lambda: descriptors() <= before - 100)
    monkeypatch.undo()
    began = time.monotonic()
    assert until(lambda: descriptors() == before)
    assert time.monotonic() - began < 2.0


@pytest.mark.parametrize(
    ("soft", "hard", "wanted"),
    [
        (1_024, 4_096, (4_096, 4_096)),
        (1_024, 10**6, (65_536, 10**6)),
        (1_024, resource.RLIM_INFINITY, (65_536, resource.RLIM_INFINITY)),
        (4_096, 4_096, None),
        (65_536, 10**6, None),
        (10**5, 10**6, None),
    ],
)
def test_a_process_takes_as_many_descriptors_as_it_may_and_never_fewer_than_before(monkeypatch, soft, hard, wanted):
    asked: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "getrlimit", lambda _: (soft, hard))
    monkeypatch.setattr(resource, "setrlimit", lambda _, limits: asked.append(limits))
    raise_descriptor_limit()
    assert asked == ([] if wanted is None else [wanted])


@pytest.mark.parametrize("above", [600, 1_900])
def test_a_socket_is_found_also_where_many_numbers_below_it_are_free(above: int) -> None:
    highest = max(map(int, os.listdir("/proc/self/fd")))
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        copy = os.dup2(server.fileno(), highest + above)
    try:
        assert port in listening_ports()
    finally:
        os.close(copy)
    assert port not in listening_ports()


def test_the_kernel_holds_back_silent_connections_at_the_named_ports_for_minutes(tmp_path: Path) -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as mine,
        socket.create_server(("127.0.0.1", 0)) as other,
        socket.create_connection(other.getsockname()) as link,
        socket.socket() as idle,
        socket.socket(socket.AF_UNIX) as local,
    ):
        idle.bind(("127.0.0.1", 0))
        local.bind(str(tmp_path / "bus"))
        local.listen()
        found = listening_ports()
        assert {mine.getsockname()[1], other.getsockname()[1]} <= found
        assert not {idle.getsockname()[1], link.getsockname()[1]} & found, "neither listens"
        assert all(isinstance(port, int) for port in found), "no socket in the file system"
        defer_accept({mine.getsockname()[1]})
        held = [one.getsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT) for one in (mine, other)]
    assert 100 <= held[0] <= 600
    assert held[1] == 0


def test_the_links_to_the_named_addresses_are_cut_off_and_no_others(door: Door) -> None:
    first, second, third = door.enter(3)
    pair = socket.socketpair()
    with pair[0], pair[1]:
        assert cut_off([first.address, second.address, ("127.0.0.1", 1)]) == 2
        assert [guest.is_cut_off for guest in (first, second, third)] == [True, True, False]
        pair[0].sendall(b"y")
        assert pair[1].recv(1) == b"y"
    assert cut_off([("127.0.0.1", 1)]) == 0
