"""Whom the gateway takes for the robot's driver before it writes a word: links are made up, the clock is the test's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from tests.ros.test_gateway_alone import ASKED, DRIVE

from safedpa.errors import InputError
from safedpa.ros.encoding import hash_of
from safedpa.ros.graph import PUBLISHER, SUBSCRIBER
from safedpa_services.ros_gateway import __main__ as module
from safedpa_services.ros_gateway import robot_file
from safedpa_services.ros_gateway.robot_file import Wire, Wish

OTHER = "geometry_msgs/msg/Twist"


class Link:
    """Knows who writes the topic, and who hears it from ``since`` [s] on."""

    form = "rmw_zenoh"

    def __init__(self, now: list[float], writers: Sequence[Any] = (), drivers: Sequence[Any] = (), since: float = 0.0):
        self.now, self.known, self.since = now, {PUBLISHER: writers, SUBSCRIBER: drivers}, since
        self.asked = 0

    def others_on(self, topic: str, kind: Any) -> list[Any]:
        assert topic == "/drive"
        self.asked += 1
        return list(self.known[kind]) if kind == PUBLISHER or self.now[0] >= self.since else []


def driver(node: str = "/driver", type_name: str = DRIVE, type_hash: str = "RIHS01_as_the_driver_asks") -> Any:
    return SimpleNamespace(node=node, type=type_name, hash=type_hash)


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    clock = [0.0]

    def sleep(seconds: float) -> None:
        clock[0] += seconds

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock[0], sleep=sleep))
    return clock


def wanted(link: Link, **asked: Any) -> str:
    made: Any = link
    return module._hash_wanted(made, replace(ASKED, **asked), DRIVE)


def test_the_drivers_own_hash_is_used_and_a_bridge_asks_for_none(now: list[float]) -> None:
    assert wanted(Link(now, drivers=[driver()])) == "RIHS01_as_the_driver_asks"
    bridge = Link(now, writers=[driver("/joystick")])
    bridge.form = "bridge"
    assert wanted(bridge) == hash_of(DRIVE)
    assert bridge.asked == 0, "over a bridge nobody is told of"


def test_where_somebody_else_drives_already_the_gateway_does_not(now: list[float]) -> None:
    """Its commands would take turns with the filter's at the wheels."""
    with pytest.raises(InputError, match=r"/drive: /joystick publishes there already; have it publish /drive_in"):
        wanted(Link(now, writers=[driver("/joystick")], drivers=[driver()]))


@pytest.mark.parametrize(("since", "found"), [(0.0, True), (9.5, True), (10.6, False), (90.0, False), (1e9, False)])
def test_a_driver_is_waited_for_ten_seconds(now: list[float], since: float, found: bool) -> None:
    link = Link(now, drivers=[driver()], since=since)
    if found:
        assert wanted(link) == "RIHS01_as_the_driver_asks"
        return
    with pytest.raises(InputError, match="nobody listens there after 10 s"):
        wanted(link)
    assert now[0] < 11.0


def test_a_driver_that_wants_another_type_is_named_whoever_else_hears_the_topic(now: list[float]) -> None:
    """What it cannot read it does not obey, the brake included."""
    for heard in ([driver("/base", OTHER)], [driver(), driver("/base", OTHER)]):
        with pytest.raises(InputError, match=f"got '{DRIVE}', /base on /drive wants '{OTHER}'"):
            wanted(Link(now, drivers=heard))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({}, ""),
        ({"wish": Wish("/drive")}, "wish.topic: got the command's own, '/drive'"),
        ({"wish": Wish("drive")}, "wish.topic: got the command's own, '/drive'"),  # the same topic, written otherwise
        ({"wish": Wish("")}, ""),
        ({"wish": Wish("/drive_in")}, ""),
        ({"wire": Wire(form="bridge", markers="drive")}, "wire.markers: got the command's own topic, 'drive'"),
        ({"wire": Wire(form="bridge", diagnostics="/drive")}, "wire.diagnostics: got the command's own topic"),
    ],
)
def test_nothing_but_the_filters_action_is_written_to_the_drivers_topic(changes: dict[str, Any], told: str) -> None:
    found = replace(ASKED, **changes)
    if not told:
        robot_file._check_topics(found)
        return
    with pytest.raises(InputError, match=told):
        robot_file._check_topics(found)
