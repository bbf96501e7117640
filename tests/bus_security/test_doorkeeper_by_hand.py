"""How long whoever is on the way in may take, by how many there are and how many descriptors are left; no network."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus.security import doorkeeper as module
from safedpa.bus.security.doorkeeper import Doorkeeper, cut_off, defer_accept


class Sockets:
    """Connections by descriptor, of which those that are shut down are noted."""

    def __init__(self) -> None:
        self.peers: dict[int, tuple[str, int]] = {}
        self.shut: list[int] = []
        self.family = socket.AF_INET

    @contextlib.contextmanager
    def borrowed(self, descriptor: int) -> Iterator[Any]:
        yield SimpleNamespace(
            family=self.family,
            getpeername=lambda: (*self.peers[descriptor], 0, 0)[: 2 if self.family == socket.AF_INET else 4],
            shutdown=lambda _: self.shut.append(descriptor),
        )


class Keeper(Doorkeeper):  # type: ignore[misc]
    """One that looks when it is told to, and has as many descriptors as the test says."""

    def __init__(self, sockets: Sockets, members: set[tuple[str, int]], short: bool) -> None:
        self.now, self.short = 100.0, short
        self.waited: list[float] = []
        self._ports, self._members, self._clock = {7447}, lambda: members, lambda: self.now
        self._strangers, self._kept_back = {}, []
        self._sockets = sockets
        self._ended: Any = SimpleNamespace(wait=self.waited.append)
        self._cut, self._told = 0, 0.0

    def _keep_back(self) -> bool:
        return not self.short

    def _connections(self) -> Any:
        return [*self._sockets.peers.items()]


def keeper_of(
    monkeypatch: pytest.MonkeyPatch, count: int, *, members: int = 0, short: bool = False
) -> tuple[Keeper, Sockets]:
    sockets = Sockets()
    sockets.peers = {number: ("10.0.0.1", 5000 + number) for number in range(count + members)}
    monkeypatch.setattr(module, "_borrowed", sockets.borrowed)
    known = {sockets.peers[number] for number in range(count, count + members)}
    return Keeper(sockets, known, short), sockets


@pytest.mark.parametrize(
    ("count", "short", "allowed", "too_long"),
    [(1, False, 2.9, 3.1), (32, False, 2.9, 3.1), (33, False, 0.35, 0.45),
     (1, True, 0.09, 0.11), (33, True, 0.09, 0.11)],
)  # fmt: skip
def test_whoever_is_on_the_way_in_has_three_seconds_and_less_where_many_are_or_room_is_short(
    count: int, short: bool, allowed: float, too_long: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeper, sockets = keeper_of(monkeypatch, count, members=40, short=short)
    assert keeper.look() == 0
    keeper.now += allowed
    assert keeper.look() == 0
    keeper.now += too_long - allowed
    assert keeper.look() == count
    assert sorted(sockets.shut) == list(range(count))
    assert keeper.look() == 0, "each is cut off once"
    assert all(0.1 <= seconds <= 1.0 for seconds in keeper.waited)
    assert bool(keeper.waited) is short


def test_who_came_in_meanwhile_and_who_came_anew_under_the_same_number_are_let_be(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    keeper, sockets = keeper_of(monkeypatch, 3)
    keeper.look()
    keeper.now += 2.0
    sockets.peers[1] = ("10.0.0.9", 1)  # another one, who got the number of one that left
    keeper.look()
    keeper.now += 1.5
    keeper._members = lambda: {sockets.peers[2]}
    assert keeper.look() == 1
    assert sockets.shut == [0]
    keeper.now += 1.6
    assert keeper.look() == 1
    assert sockets.shut == [0, 1]


@pytest.mark.parametrize(("family", "count"), [(socket.AF_INET, 1), (socket.AF_INET6, 1), (socket.AF_UNIX, 0)])
def test_links_are_cut_off_by_their_far_ends_and_no_socket_of_this_machine_is(
    family: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, sockets = keeper_of(monkeypatch, 3)
    sockets.family = family  # type: ignore[assignment]
    monkeypatch.setattr(module, "_sockets", lambda: [*sockets.peers])
    assert cut_off({("10.0.0.1", 5001), ("10.0.0.2", 5000)}) == count
    assert sockets.shut == [1] * count


def test_silent_connections_at_our_ports_are_held_back_by_the_kernel_for_minutes_and_at_no_others() -> None:
    with socket.create_server(("127.0.0.1", 0)) as ours, socket.create_server(("127.0.0.1", 0)) as other:
        defer_accept({ours.getsockname()[1]})
        held = [one.getsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT) for one in (ours, other)]
    assert 100 <= held[0] <= 600
    assert held[1] == 0
