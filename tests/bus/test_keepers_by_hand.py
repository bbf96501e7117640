"""Which sockets of a process a doorkeeper looks at: those that listen, and connections to their ports; no others."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus.security import doorkeeper as module
from safedpa.bus.security.doorkeeper import Doorkeeper, listening_ports


def test_ports_are_those_at_which_this_process_listens_to_a_network(tmp_path: Path) -> None:
    """Neither the far nor the near end of a connection, nor a socket in the file system."""
    before = listening_ports()
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()),
        socket.create_server(("127.0.0.1", 0)) as other,
        socket.socket(socket.AF_UNIX) as local,
    ):
        local.bind(str(tmp_path / "bus"))
        local.listen()
        assert listening_ports() - before == {server.getsockname()[1], other.getsockname()[1]}


@pytest.mark.parametrize(
    ("family", "own", "far", "peer"),
    [
        (socket.AF_INET, ("10.0.0.1", 7447), ("10.0.0.2", 5000), ("10.0.0.2", 5000)),
        (socket.AF_INET6, ("::1", 7447, 0, 0), ("::1", 5000, 0, 0), ("::1", 5000)),
        (socket.AF_INET, ("10.0.0.1", 7448), ("10.0.0.2", 5000), None),  # another door
        (socket.AF_INET, ("10.0.0.1", 5000), ("10.0.0.2", 7447), None),  # one that we opened
        (socket.AF_INET, ("10.0.0.1", 7447), None, None),  # listens
        (40, (3, 7447), (2, 5000), None),  # Linux's AF_VSOCK, between virtual machines
        (socket.AF_UNIX, "", "", None),
    ],
)
def test_connections_to_our_ports_are_known_by_their_far_ends(
    family: int, own: Any, far: Any, peer: tuple[str, int] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def getpeername() -> Any:
        if far is None:
            raise OSError(107, "not connected")
        return far

    @contextlib.contextmanager
    def borrowed(_: int) -> Iterator[Any]:
        yield SimpleNamespace(family=family, getsockname=lambda: own, getpeername=getpeername)

    monkeypatch.setattr(module, "_borrowed", borrowed)
    keeper: Any = SimpleNamespace(_ports={7447})
    assert Doorkeeper._peer(keeper, 9) == peer


@pytest.mark.parametrize(("cut", "told"), [(0, []), (3, [12, 12, 12])])
def test_once_a_second_it_is_told_how_many_were_cut_off(
    cut: int, told: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Looked at every 0.3 s for 4 s: the first that is later than a second is the fourth."""
    now, events, looks = [100.0], list[tuple[str, int]](), list[float]()

    def wait(seconds: float) -> bool:
        looks.append(seconds)
        now[0] += 0.3
        return len(looks) > 13

    monkeypatch.setattr(module, "log_event", lambda kind, _, count, **__: events.append((kind, count)))
    keeper: Any = SimpleNamespace(
        _ended=SimpleNamespace(wait=wait), _clock=lambda: now[0], look=lambda: cut, _cut=0, _told=100.0
    )
    Doorkeeper._watch(keeper)
    assert events == [("bus.strangers_cut_off", count) for count in told]
    assert all(0.05 <= seconds <= 0.2 for seconds in looks)
