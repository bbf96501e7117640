"""The gateway's own numbers: how old what it hears may be, which actions it takes for its own, when it speaks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest
from tests.ros.test_gateway_alone import ASKED, LIMITS, Link, Publisher, Quiet, Sense
from tests.ros.test_gateway_senses import scan_of

from safedpa.bus import (
    HEALTH,
    SCAN,
    STATE,
    WISH,
    ActionMessage,
    Bus,
    HealthMessage,
    MemoryBroker,
    MemoryTransport,
    Received,
)
from safedpa.robots.car.ros_face import CarFace
from safedpa_services.ros_gateway import gateway as module
from safedpa_services.ros_gateway.gateway import Gateway
from safedpa_services.ros_gateway.overheard import Overheard
from safedpa_services.ros_gateway.robot_file import Localisation, Scan
from safedpa_services.ros_gateway.scanner import Scanner
from safedpa_services.ros_gateway.senses import Senses
from safedpa_services.ros_gateway.voice import Voice

PLACE = (1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 0.0, 1.0)


class Rig:
    """A gateway at a time that the test sets, what its driver got and what the bus heard."""

    def __init__(
        self, broker: MemoryBroker, bus: Bus, ear: Bus, *, localised: Sense | None, wish: Sense | None
    ) -> None:
        self.now, self.drive, self.ear = [100.0], Publisher(), ear
        self.odometry, self.driver = Sense(PLACE), Overheard("/drive", lambda: self.now[0])
        senses: Any = Senses(self.odometry, self.driver, wish, None, localised)  # type: ignore[arg-type]
        asked = replace(ASKED, localisation=Localisation("/tf"))
        voice = Voice("r1", "odom", CarFace(), None, None)
        command: Any = self.drive
        link: Any = Link()
        self.gateway = Gateway(bus, link, asked, CarFace(), LIMITS, senses, command, voice, 0.05, lambda: self.now[0])
        self.inbox = ear.inbox((STATE, WISH, HEALTH), "r1")
        self.gateway._verdicts = Quiet(self.now)  # type: ignore[assignment]
        self.gateway._inbox = Quiet(self.now)  # type: ignore[assignment]

    def turned(self) -> list[Any]:
        """What the bus heard of one period."""
        self.gateway._turn(self.now[0])
        return [item.message for item in self.inbox.take(0.0) if isinstance(item, Received)]


Made = Callable[..., Rig]


@pytest.fixture
def made() -> Iterator[Made]:
    broker = MemoryBroker()
    with Bus(MemoryTransport(broker), "fleet") as bus, Bus(MemoryTransport(broker), "fleet") as ear:
        yield lambda localised=None, wish=None: Rig(broker, bus, ear, localised=localised, wish=wish)


def kinds(messages: Sequence[Any]) -> set[str]:
    return {type(message).__name__ for message in messages} - {"HealthMessage"}


@pytest.mark.parametrize(
    ("age", "why"),
    [
        (0.0, ""),
        (1.0, ""),
        (1.01, "the transform from map to odom is 1.01 s old"),
        (9.0, "the transform from map to odom is 9.00 s old"),
        (math.inf, "the transform from map to odom is never there"),
    ],
)
def test_a_localisation_counts_for_a_second_and_then_the_robot_brakes(made: Made, age: float, why: str) -> None:
    rig = made(localised=Sense((0.0, 0.0, 0.0), age))
    rig.gateway._senses.localised.read = lambda: ((0.0, 0.0, 0.0), age)  # type: ignore
    assert kinds(rig.turned()) == (set() if why else {"StateMessage"})
    assert rig.gateway.why == (why or "no action of the filter came in time")


@pytest.mark.parametrize(
    ("age", "why"),
    [(0.1, "no action of the filter came in time"), (0.11, "the odometry is 0.11 s old"), (0.9, "0.90 s old")],
)
def test_an_odometry_counts_for_a_tenth_of_a_second_and_what_was_refused_is_told(
    made: Made, age: float, why: str
) -> None:
    rig = made()
    rig.odometry.age = age
    rig.turned()
    assert rig.gateway.why.endswith(why)
    rig.odometry.why = "two publishers"
    rig.turned()
    assert rig.gateway.why.endswith("; two publishers") is (age > 0.1)


@pytest.mark.parametrize(("age", "wished"), [(0.0, True), (0.5, True), (0.51, False), (4.0, False), (math.inf, False)])
def test_a_wish_counts_for_half_a_second(made: Made, age: float, wished: bool) -> None:
    heard = made(wish=Sense((0.5, 0.1), age)).turned()
    assert kinds(heard) == {"StateMessage"} | ({"WishMessage"} if wished else set())
    assert all(message.values == (0.5, 0.1) for message in heard if type(message).__name__ == "WishMessage")
    assert kinds(made().turned()) == {"StateMessage"}, "where nobody wishes"


@pytest.mark.parametrize(
    ("changes", "fits"),
    [
        ({}, True),
        ({"epoch": 1}, False),  # of the gateway before it was started anew
        ({"tick": 1}, False),
        ({"values": (2.0, 0.34)}, True),
        ({"values": (-0.6, -0.34)}, True),
        ({"values": (2.0 + 1e-10, 0.0)}, True),  # rounded on its way
        ({"values": (2.001, 0.0)}, False),
        ({"values": (-0.601, 0.0)}, False),
        ({"values": (0.0, 0.341)}, False),
        ({"values": (0.0, -0.341)}, False),
        ({"values": (0.0, 0.0, 0.0)}, False),
    ],
)
def test_an_action_is_of_this_epoch_and_tick_and_within_every_limit(
    made: Made, changes: dict[str, Any], fits: bool
) -> None:
    gateway = made().gateway
    stamp: dict[str, Any] = {"epoch": gateway.epoch, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
    assert gateway._fits(ActionMessage(**{**stamp, "values": (0.5, 0.1), **changes})) is fits


@pytest.mark.parametrize(("seconds", "taken"), [(0.01, True), (0.099, True), (0.101, False), (0.5, False)])
def test_an_action_is_taken_two_periods_after_its_state_at_the_latest(made: Made, seconds: float, taken: bool) -> None:
    rig = made()
    gateway = rig.gateway

    class Late:
        def take(self, _: float) -> list[Received]:
            rig.now[0] += seconds
            return [Received(STATE, "r1", action, b"", "", rig.now[0])]

    stamp: dict[str, Any] = {"epoch": gateway.epoch, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
    action = ActionMessage(**stamp, values=(0.5, 0.1))
    gateway._inbox = Late()  # type: ignore[assignment]
    assert gateway._await_action(100.0, 100.9) == ((0.5, 0.1) if taken else None)
    assert (len(gateway.latencies), gateway.refused) == (taken, not taken)


def test_periods_that_were_slept_through_are_not_made_up(made: Made) -> None:
    rig = made()
    assert rig.gateway._turn(100.0) == pytest.approx(100.05)
    rig.now[0] = 110.0
    assert rig.gateway._turn(100.05) >= 109.95


def test_it_gives_a_sign_of_life_four_times_a_second(made: Made) -> None:
    rig = made()
    beats: list[float] = []
    for _ in range(60):
        began = rig.now[0]
        heard = [message for message in rig.turned() if isinstance(message, HealthMessage)]
        beats += [began] * len(heard)
        rig.now[0] = began + 0.05
    assert 10 <= len(beats) <= 13
    assert all(0.2 < later - earlier <= 0.31 for earlier, later in pairwise(beats))


def test_why_it_brakes_is_told_once_for_each_reason_and_that_it_drives_again_too(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, told = made(), list[str]()
    monkeypatch.setattr(module, "log_event", lambda kind, sentence, **_: told.append(sentence))
    old = ("the odometry is 0.11 s old", "the odometry is 0.16 s old")
    for why in ("", "", *old, "no action of the filter came", ""):
        rig.gateway._drive(None if why else (0.5, 0.1), why)
    assert [sentence.removeprefix("the gateway brakes: ") for sentence in told] == [
        "the filter drives", old[0], "no action of the filter came", "the filter drives",
    ]  # fmt: skip
    assert rig.gateway.watchdog_ticks == 3


@pytest.mark.parametrize(
    ("asked", "heard", "goal"),
    [((), None, ()), ((3.0, 1.0), None, (3.0, 1.0)), ((3.0, 1.0), (), (3.0, 1.0)), ((3.0, 1.0), (0.0, 2.0), (0.0, 2.0)),
     ((), (0.0, 2.0), (0.0, 2.0))],
)  # fmt: skip
def test_the_goal_is_that_of_the_file_until_people_say_another(
    made: Made, asked: tuple[float, ...], heard: tuple[float, ...] | None, goal: tuple[float, ...]
) -> None:
    """Without one that was heard, a policy of this side would have no aim, though the robot's file names it."""
    rig = made()
    gateway = rig.gateway
    gateway._asked = replace(gateway._asked, surroundings=replace(gateway._asked.surroundings, goal=asked))
    said: Any = None if heard is None else Sense(heard)
    gateway._senses = replace(gateway._senses, goal=said)
    assert [message.goal for message in rig.turned() if type(message).__name__ == "StateMessage"] == [goal]


@pytest.mark.parametrize(
    ("arrived", "delay", "tick", "measured"),
    [
        (0.0, 0.0, 20, 1.0),
        (-0.02, 0.0, 19, 0.98),
        (-0.02, 0.05, 18, 0.93),
        (-0.88, 0.05, 1, 0.07),
        (-0.02, 2.0, None, None),  # before the first state
        (+0.02, 0.0, 20, 1.0),  # after the newest odometry: told of the state that is sent now
    ],
)
def test_a_scan_is_told_of_the_tick_and_the_time_at_which_it_was_measured(
    made: Made, arrived: float, delay: float, tick: int | None, measured: float | None
) -> None:
    """Seen at 1 s by the robot's clock, 20 ticks: what was measured 70 ms before belongs to the 19th period."""
    rig = made()
    gateway, ear = rig.gateway, rig.ear.inbox((SCAN,), "r1")
    gateway.tick = 20
    turn = SimpleNamespace(
        arrived=rig.now[0] + arrived, first_angle=0.0, angle_step=0.1, ranges=(1.0, 2.0), nearest=0.1, farthest=9.0
    )
    gateway._asked = replace(gateway._asked, scans=(Scan("/scan", delay=delay),))
    scanner: Any = SimpleNamespace(taken=lambda: [turn], refused=0, why="")
    gateway._senses = replace(gateway._senses, scanners=(scanner,))
    gateway._publish_scans(0.0)
    heard: list[Any] = [item.message for item in ear.take(0.0) if isinstance(item, Received)]
    assert [message.tick for message in heard] == ([] if tick is None else [tick])
    assert [message.robot_time for message in heard] == ([] if measured is None else [pytest.approx(measured)])
    assert all((message.ranges, message.number) == ((1.0, 2.0), 1) for message in heard)


@pytest.mark.parametrize("form", ["rmw_zenoh", "bridge"])
@pytest.mark.parametrize("announced", [True, False])
@pytest.mark.parametrize("overheard", [True, False])
def test_it_brakes_while_anybody_else_commands_whether_he_is_announced_or_only_heard(
    made: Made, form: str, announced: bool, overheard: bool
) -> None:
    """A bridge tells of no publishers; who is in the graph is named, whoever is heard besides."""
    rig = made()
    link: Any = SimpleNamespace(form=form, watched=lambda *_: [SimpleNamespace(node="/joystick")] * announced)
    rig.gateway._link = link
    if overheard:
        rig.driver.take(b"")
    named, heard = announced and form == "rmw_zenoh", overheard
    states = kinds(rig.turned())
    assert states == (set() if named or heard else {"StateMessage"})
    why = rig.gateway.why
    assert why.startswith("/joystick publishes on /drive too") is named
    assert why.startswith("somebody who shows no token") is (heard and not named)
    assert rig.drive.sent[-1] == (0.0, 0.0)
    rig.now[0] += 2.0
    assert (kinds(rig.turned()) == {"StateMessage"}) is not named, "who fell silent is gone"


@pytest.mark.parametrize(("sent", "kept"), [(1, 1), (8, 8), (9, 8), (40, 8)])
def test_of_the_scans_between_two_periods_the_newest_eight_are_kept(sent: int, kept: int) -> None:
    scanner = Scanner("laser")
    for number in range(sent):
        scanner.take(scan_of([1.0 + number / 100.0] * 7, header=head(number + 1)))
    newest = [1.0 + number / 100.0 for number in range(sent)][-kept:]
    assert [turn.ranges[0] for turn in scanner.taken()] == pytest.approx(newest)


def test_scans_without_a_stamp_are_all_news() -> None:
    scanner = Scanner("laser")
    for _ in range(3):
        scanner.take(scan_of([1.0] * 7, header={"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "laser"}))
    assert len(scanner.taken()) == 3


@pytest.mark.parametrize(
    ("rays", "step", "first", "believed"),
    [
        (8192, 2.0 * math.pi / 8192, 0.0, True),
        (8193, 2.0 * math.pi / 8193, 0.0, False),
        (5, math.pi / 2.0, 0.0, True),  # the first direction once more at the end
        (7, math.pi / 2.0, 0.0, False),
        (5, -math.pi / 2.0, 0.0, True),
        (7, -math.pi / 2.0, 0.0, False),
        (4, 0.1, 12.5, True),
        (4, 0.1, -12.5, True),
        (4, 0.1, 12.6, False),
        (4, 0.1, -12.6, False),
    ],
)
def test_a_scan_has_so_many_rays_and_no_more_than_one_turn(
    rays: int, step: float, first: float, believed: bool
) -> None:
    scanner = Scanner("laser")
    scanner.take(scan_of([1.0] * rays, angle_min=first, angle_increment=step))
    assert (len(scanner.taken()), scanner.refused) == (believed, not believed)


@pytest.mark.parametrize(
    ("nearest", "farthest", "believed"), [(0.0, 1000.0, True), (0.1, 1001.0, False), (2.0, 2.0, False)]
)
def test_a_scan_reaches_from_nothing_to_a_kilometre(nearest: float, farthest: float, believed: bool) -> None:
    scanner = Scanner("laser")
    scanner.take(scan_of([1.0] * 7, range_min=nearest, range_max=farthest))
    assert len(scanner.taken()) == believed


def head(nanoseconds: int) -> dict[str, Any]:
    return {"stamp": {"sec": 1, "nanosec": nanoseconds}, "frame_id": "laser"}
