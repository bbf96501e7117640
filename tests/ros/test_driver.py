"""Which drivers the gateway refuses before its first command."""

import time
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Self

import pytest
from tests.ros.gateway_rig import ASKED, DRIVE

from safedpa.bus import Bus, MemoryBroker, MemoryTransport
from safedpa.errors import InputError
from safedpa.ros.encoding import hash_of
from safedpa.ros.graph import SUBSCRIBER
from safedpa_services.ros_gateway import __main__ as gateway
from safedpa_services.ros_gateway.robot_file import RosConnection

OTHER = "geometry_msgs/msg/Twist"


class Link:
    """A link with given publishers of the driver's topic, and subscribers from ``since`` on."""

    def __init__(self, writers: Sequence[Any] = (), drivers: Sequence[Any] = (), since: float = 0.0) -> None:
        self.writers, self.drivers, self.since = writers, drivers, since
        self.form, self.hashes = "", dict[str, str]()

    def __call__(self, _endpoint: str, _domain: int, form: str) -> Self:
        self.form = form
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Does nothing."""

    def others_on(self, topic: str, kind: str) -> list[Any]:
        assert topic == "/drive"
        assert self.form == "rmw_zenoh", "over a bridge no publisher is known"
        if kind == SUBSCRIBER:
            return list(self.drivers) if time.monotonic() >= self.since else []
        return list(self.writers)

    def publisher(self, topic: str, type_name: str, type_hash: str = "") -> Any:
        self.hashes[topic] = type_hash
        return SimpleNamespace(type=type_name, put=lambda _: None)

    def watched(self, *_: Any) -> list[Any]:
        return []

    def hear(self, *_: Any, late: bool = False) -> None:
        """Receives nothing."""

    overhear = hear


def driver(node: str = "/driver", type_name: str = DRIVE) -> Any:
    return SimpleNamespace(node=node, type=type_name, hash="RIHS01_of_the_driver")


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    clock = [0.0]

    def sleep(seconds: float) -> None:
        clock[0] += seconds

    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(time, "sleep", sleep)
    return clock


@pytest.fixture
def hash_used(now: list[float], monkeypatch: pytest.MonkeyPatch) -> Any:
    def of(link: Link, form: str = "rmw_zenoh") -> str:
        monkeypatch.setattr(gateway, "RosLink", link)
        asked = replace(ASKED, wire=RosConnection(form=form))
        with Bus(MemoryTransport(MemoryBroker()), "fleet") as bus, gateway.make_gateway(asked, bus):
            return link.hashes["/drive"]

    return of


def test_commands_carry_the_hash_of_the_driver_or_over_a_bridge_our_own(hash_used: Any) -> None:
    assert hash_used(Link(drivers=[driver()])) == "RIHS01_of_the_driver"
    assert hash_used(Link(writers=[driver("/joystick")]), "bridge") == hash_of(DRIVE)


def test_a_gateway_does_not_start_while_another_publisher_drives(hash_used: Any) -> None:
    with pytest.raises(InputError, match=r"/drive: /joystick publishes there; let it publish to /drive_in"):
        hash_used(Link(writers=[driver("/joystick")], drivers=[driver()]))


@pytest.mark.parametrize(("since", "found"), [(0.0, True), (9.5, True), (10.6, False), (1e9, False)])
def test_a_gateway_waits_ten_seconds_for_the_driver(since: float, found: bool, hash_used: Any, now: list[float]):
    link = Link(drivers=[driver()], since=since)
    if found:
        assert hash_used(link) == "RIHS01_of_the_driver"
    else:
        with pytest.raises(InputError, match="no subscriber after 10 s"):
            hash_used(link)
    assert now[0] < 11.0


def test_a_driver_of_another_type_is_named_whatever_else_hears_the_topic(hash_used: Any) -> None:
    """It could not read the commands, including the braking command."""
    for heard in ([driver("/base", OTHER)], [driver(), driver("/base", OTHER)]):
        with pytest.raises(InputError, match=f"got '{DRIVE}', wanted '{OTHER}', the type of /base"):
            hash_used(Link(drivers=heard))
