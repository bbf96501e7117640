"""Who is cut off at the door and when, how many descriptors are kept back, where sockets are looked for: by hand."""

from __future__ import annotations

import os
import resource
import select
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from safedpa.bus.security import doorkeeper
from safedpa.bus.security.doorkeeper import (
    Doorkeeper,
    _sockets,
    as_many_descriptors_as_allowed,
    cut_off,
    defer_accept,
    listening_ports,
)

HERE = "127.0.0.1"
NONE = 10**9
"""No descriptor has this number, so nothing is cut off but in name."""


WATCH = Doorkeeper._watch


class Turned:
    """In place of the keeper's event: every wait is told, and the so manyeth is the last."""

    def __init__(self, turns: int = 0) -> None:
        self.waited: list[float] = []
        self._turns = turns

    def wait(self, seconds: float) -> bool:
        self.waited.append(seconds)
        return len(self.waited) > self._turns

    def set(self) -> None:
        return


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Any]]:
    """Makes keepers whose thread does nothing, on a clock that begins at 0."""
    monkeypatch.setattr(Doorkeeper, "_watch", lambda self: None)
    keepers = []

    def made(*connections: tuple[int, Any], members: Any = (), ports: Any = frozenset({1})) -> Any:
        keeper: Any = Doorkeeper(set(ports), lambda: members, lambda: keeper_clock[0])
        keeper.seen, keeper.clock = list(connections), keeper_clock
        if connections:
            monkeypatch.setattr(keeper, "_connections", lambda: iter(keeper.seen))
        keepers.append(keeper)
        return keeper

    keeper_clock = [0.0]
    yield made
    for keeper in keepers:
        keeper.close()


def strangers(count: int) -> list[tuple[int, Any]]:
    return [(NONE + number, (HERE, number)) for number in range(count)]


@pytest.mark.parametrize(("count", "patience"), [(1, 3.0), (32, 3.0), (33, 0.4), (100, 0.4)])
def test_a_stranger_has_three_seconds_and_beside_more_than_thirty_others_less(
    kept: Any, count: int, patience: float
) -> None:
    keeper = kept(*strangers(count))
    assert keeper.look() == 0
    keeper.clock[0] = patience
    assert keeper.look() == 0, "not yet"
    keeper.clock[0] = patience + 1e-6
    assert keeper.look() == count
    assert keeper.look() == 0, "who connects anew has as long again"
    keeper.clock[0] = 2.0 * patience + 1e-5
    assert keeper.look() == count


def test_who_got_in_and_who_is_another_by_now_is_not_cut_off(kept: Any) -> None:
    keeper = kept(*strangers(3), members=[(HERE, 0)])
    keeper.look()
    keeper.seen[2] = (NONE + 2, (HERE, 77))
    keeper.clock[0] = 3.5
    assert keeper.look() == 1, "one is a member, and behind one number is another far end than before"
    keeper.clock[0] = 6.5
    assert keeper.look() == 0
    keeper.clock[0] = 6.6
    assert keeper.look() == 1, "3.1 s after it came"


def test_who_is_cut_off_sees_an_end_and_a_stranger_who_took_its_number_does_not(kept: Any) -> None:
    with socket.create_server((HERE, 0)) as listening:
        port = listening.getsockname()[1]
        keeper = kept(ports={port})
        with socket.create_connection((HERE, port)) as link, listening.accept()[0] as accepted:
            found = [(number, peer) for number, peer in keeper._connections() if number == accepted.fileno()]
            assert found == [(accepted.fileno(), link.getsockname())]
            assert link.fileno() not in {number for number, _ in keeper._connections()}, "its own port is another"
            assert listening.fileno() not in {number for number, _ in keeper._connections()}
            keeper.look()
            keeper.clock[0] = 3.5
            assert keeper.look() == 1
            link.settimeout(10.0)
            assert link.recv(1) == b""
        with socket.create_connection((HERE, port)) as link, listening.accept()[0] as accepted:
            keeper.seen = [(accepted.fileno(), (HERE, 1))]
            keeper._connections = lambda: iter(keeper.seen)
            keeper.look()
            keeper.clock[0] = 10.0
            keeper.look()
            accepted.sendall(b"still here")
            link.settimeout(10.0)
            assert link.recv(10) == b"still here"


def test_where_no_descriptor_is_left_those_kept_back_are_let_go_for_a_moment(
    kept: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeper = kept(*strangers(2))
    keeper._ended = event = Turned()
    keeper.look()
    assert event.waited == []
    there = list(keeper._kept_back)
    assert there
    plain, tries = os.dup, [0]

    def none_left(descriptor: int) -> int:
        tries[0] += 1
        if tries[0] == 1:
            raise OSError("Too many open files")
        return plain(descriptor)

    released: list[bool] = []
    monkeypatch.setattr(os, "dup", none_left)

    def waiting(seconds: float) -> bool:
        released.append(not keeper._kept_back)
        event.waited.append(seconds)
        return False

    monkeypatch.setattr(event, "wait", waiting)
    keeper.clock[0] = 0.1
    assert keeper.look() == 0, "0.1 s is given"
    assert event.waited == [0.25]
    assert released == [True]
    assert len(keeper._kept_back) == len(there), "taken again"
    tries[0] = 0
    keeper.clock[0] = 0.1 + 1e-6
    assert keeper.look() == 2


@pytest.mark.parametrize(("limit", "wanted"), [(6_000, 160), (960, 160), (600, 100), (605, 100)])
def test_a_sixth_of_all_descriptors_is_kept_back_and_160_at_most(
    kept: Any, monkeypatch: pytest.MonkeyPatch, limit: int, wanted: int
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit, 10 * limit))
    plain, doubled = os.dup, set()

    def dup(descriptor: int) -> int:
        doubled.add(descriptor)
        return plain(descriptor)

    monkeypatch.setattr(os, "dup", dup)
    before = len(os.listdir("/proc/self/fd"))
    keeper = kept()
    assert len(os.listdir("/proc/self/fd")) - before == wanted == len(keeper._kept_back)
    assert keeper._keep_back() is True
    assert doubled == {2}, "standard error, which every process has"
    assert keeper._thread.daemon, "a keeper that nobody closed holds up no end"
    assert len(os.listdir("/proc/self/fd")) - before == wanted, "no more are taken, nor is one left open by asking"
    keeper.close()
    assert len(os.listdir("/proc/self/fd")) == before


def test_every_tenth_of_a_second_is_looked_and_once_a_second_told(kept: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[str, str, Any]] = []
    monkeypatch.setattr(doorkeeper, "log_event", lambda kind, sentence, **more: told.append((kind, sentence, more)))
    keeper = kept(*strangers(1))
    moments = iter([(0.5, 2), (1.0, 0), (1.01, 3), (1.5, 4), (1.6, 1), (2.02, 0), (9.0, 0)])

    def look() -> int:
        keeper.clock[0], cut = next(moments)
        return cut

    keeper._ended = event = Turned(7)
    keeper.look = look
    WATCH(keeper)
    assert set(event.waited) == {0.1}
    assert [more["count"] for _, _, more in told] == [5, 5]
    assert {kind for kind, _, _ in told} == {"bus.strangers_cut_off"}
    assert {more["level"] for _, _, more in told} == {"warning"}
    assert told[0][1].startswith("5 connections were cut off")


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
def test_as_many_descriptors_are_allowed_as_can_be_and_never_fewer_than_before(
    monkeypatch: pytest.MonkeyPatch, soft: int, hard: int, wanted: tuple[int, int] | None
) -> None:
    asked: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "getrlimit", lambda _: (soft, hard))
    monkeypatch.setattr(resource, "setrlimit", lambda _, limits: asked.append(limits))
    as_many_descriptors_as_allowed()
    assert asked == ([] if wanted is None else [wanted])


class Answers:
    """In place of the kernel: of which questions all numbers are gone."""

    def __init__(self, gone: Callable[[int], bool]) -> None:
        self.asked: list[range] = []
        self._gone = gone

    def __call__(self, numbers: range) -> Any:
        self.asked.append(numbers)
        return self

    def poll(self, milliseconds: int) -> list[tuple[int, int]]:
        assert milliseconds == 0, "it must not wait"
        numbers = self.asked[-1]
        return [(number, select.POLLNVAL if self._gone(len(self.asked)) else select.POLLHUP) for number in numbers]


@pytest.mark.parametrize(
    ("limit", "gone", "questions"),
    [
        (1_300, lambda _: False, 3),
        (10**6, lambda _: False, 128),
        (10**6, lambda _: True, 4),
        (10**6, lambda question: question % 4 != 0, 128),
        (10**6, lambda question: question > 2, 6),
    ],
)
def test_sockets_are_looked_for_up_to_the_limit_or_a_gap(
    monkeypatch: pytest.MonkeyPatch, limit: int, gone: Callable[[int], bool], questions: int
) -> None:
    """65,536 numbers at most, in questions of 512; after four in a row that find nothing no more are asked."""

    def closed(_: int) -> os.stat_result:
        raise OSError("closed meanwhile")

    answers = Answers(gone)
    with monkeypatch.context() as patch:
        patch.setattr(resource, "getrlimit", lambda _: (limit, 10 * limit))
        patch.setattr(doorkeeper, "_question", answers)
        patch.setattr(os, "fstat", closed)
        found = list(_sockets())
    assert found == []
    assert len(answers.asked) == questions
    flat = [number for numbers in answers.asked for number in numbers]
    assert flat == list(range(min(limit, 512 * questions)))


def test_the_kernel_holds_back_who_is_silent_at_the_ports_that_are_named_alone() -> None:
    with socket.create_server((HERE, 0)) as mine, socket.create_server((HERE, 0)) as other, socket.socket() as idle:
        idle.bind((HERE, 0))
        found = listening_ports()
        assert {mine.getsockname()[1], other.getsockname()[1]} <= found
        assert idle.getsockname()[1] not in found, "it does not listen"
        defer_accept({mine.getsockname()[1]})
        waits = [one.getsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT) for one in (mine, other)]
        assert waits[0] >= 250
        assert waits[1] == 0


def test_of_all_links_those_to_the_named_addresses_are_cut_off() -> None:
    with ExitStack() as held:
        listening = held.enter_context(socket.create_server((HERE, 0)))
        links = [held.enter_context(socket.create_connection(listening.getsockname())) for _ in range(3)]
        accepted = {}
        for _ in links:
            end, peer = listening.accept()
            accepted[peer] = held.enter_context(end)
        pair = socket.socketpair()
        for one in pair:
            held.enter_context(one)
        names = [link.getsockname() for link in links]
        assert cut_off(names[:2]) == 2
        for link in links[:2]:
            link.settimeout(10.0)
            assert link.recv(1) == b""
        accepted[names[2]].sendall(b"x")
        links[2].settimeout(10.0)
        assert links[2].recv(1) == b"x"
        pair[0].sendall(b"y")
        assert pair[1].recv(1) == b"y"
        assert cut_off([(HERE, 1)]) == 0


@pytest.fixture
def by_six() -> Iterator[tuple[socket.socket, socket.socket, socket.socket]]:
    """(listening, far end, accepted) over IPv6, whose addresses have four parts."""
    try:
        listening = socket.create_server(("::1", 0), family=socket.AF_INET6)
    except OSError:
        pytest.skip("no IPv6 here")
    with listening, socket.create_connection(listening.getsockname()[:2]) as link, listening.accept()[0] as accepted:
        yield listening, link, accepted


def test_links_by_ipv6_are_cut_off_by_host_and_port(by_six: Any, kept: Any) -> None:
    listening, link, accepted = by_six
    keeper = kept(ports={listening.getsockname()[1]})
    assert (accepted.fileno(), link.getsockname()[:2]) in list(keeper._connections())
    keeper.look()
    keeper.clock[0] = 3.5
    assert keeper.look() == 1
    link.settimeout(10.0)
    assert link.recv(1) == b""


def test_a_named_link_by_ipv6_is_cut_off_too(by_six: Any) -> None:
    _, link, _ = by_six
    assert cut_off([link.getsockname()[:2]]) == 1
    link.settimeout(10.0)
    assert link.recv(1) == b""
