"""What is kept of a fleet that is looked at: counts of the last seconds, heartbeats, who was replaced or left."""

from __future__ import annotations

from typing import Any

import pytest
from tests.operations.conftest import _STATE

from safedpa.bus import Bus, HealthMessage, MemoryBroker, MemoryTransport, Received, StateMessage
from safedpa.bus.overview.fleet import FleetOverview
from safedpa.bus.overview.recent import Recent
from safedpa.bus.overview.service import ServiceOverview
from safedpa.bus.wire.topics import HEALTH, STATE
from safedpa_services.command_line.status import document_of


def beat(steps: int = 0, stale: int = 0, sent: float = 0.0, **changes: Any) -> HealthMessage:
    told: dict[str, Any] = {"epoch": 1, "tick": 1, "robot_time": 0.0, "service": "s", "pid": 1, "state": "running"}
    return HealthMessage(**{**told, **changes}, steps=steps, stale=stale, publish_time=sent)


def service(**changes: Any) -> ServiceOverview:
    first = beat(**changes)
    found = ServiceOverview("s", 1, first, 0.0)
    found.hear("a", first, 0.0)
    return found


def test_counts_are_those_of_the_last_ten_seconds_in_slices_of_half_a_second() -> None:
    recent = Recent()
    for at in (0.0, 0.4, 0.5, 3.0):
        recent.add("late", at)
    recent.add("fine", 3.0)
    assert recent.counts(9.9) == {"late": 4, "fine": 1}
    assert recent.share("late", 9.9) == 0.8
    assert recent.counts(10.0) == {"late": 2, "fine": 1}
    assert recent.counts(10.5) == {"late": 1, "fine": 1}
    assert recent.share("late", 12.9) == 0.5
    assert recent.share("late", 13.0) == 0.0


@pytest.mark.parametrize(
    ("now", "rate"), [(0.0, 0.0), (0.49, 0.0), (0.5, 4.0), (2.0, 1.0), (9.0, 2.0 / 9.0), (11.0, 0.0)]
)
def test_a_rate_is_told_from_half_a_second_on(now: float, rate: float) -> None:
    recent = Recent()
    assert recent.rate(now) == 0.0
    for at in (0.0, 0.1):
        recent.add("tick", at)
    assert recent.rate(now) == pytest.approx(rate)


def test_over_more_than_ten_seconds_a_rate_is_over_ten() -> None:
    recent = Recent()
    for second in range(31):
        recent.add("tick", float(second))
    assert recent.rate(30.0) == pytest.approx(1.0)


@pytest.mark.parametrize(("sent", "steps"), [(4.9, 10), (5.0, 12), (5.1, 12)])
def test_a_heartbeat_that_was_overtaken_by_a_newer_one_is_left_out(sent: float, steps: int) -> None:
    found = service(steps=10, sent=5.0)
    found.hear("a", beat(12, sent=sent), 1.0)
    assert (found.steps, found.at) == (steps, 1.0 if steps == 12 else 0.0)
    found.hear("b", beat(7, sent=0.0), 2.0)  # of another robot nothing newer is known
    assert (found.steps, found.at, found.robots) == (steps + 7, 2.0, ["a", "b"])


@pytest.mark.parametrize(
    ("steps", "stale", "together"), [(12, 3, (12, 3)), (2, 1, (12, 4)), (10, 2, (20, 5)), (2, 9, (12, 12))]
)
def test_what_was_counted_stays_when_a_robot_begins_anew(steps: int, stale: int, together: tuple[int, int]) -> None:
    """Either count that falls tells so."""
    found = service(steps=10, stale=3)
    found.hear("a", beat(steps, stale, 1.0), 1.0)
    assert (found.steps, found.stale) == together


def test_what_was_counted_for_robots_of_which_nothing_is_told_any_more_stays() -> None:
    found = service(steps=10, stale=3)
    found.hear("b", beat(5, 1, 1.0), 1.0)
    found.hear("-", beat(0, 0, 2.0), 2.0)
    found.forget(0.0)
    assert found.robots == ["a", "b"]
    found.forget(1.0)
    assert (found.robots, found.steps, found.stale) == (["b"], 15, 4)
    assert (found.age(2.5), found.age(1.0)) == (0.5, 0.0)


def test_a_failure_about_one_robot_is_one_of_the_process() -> None:
    found = service()
    assert (found.failing, found.state) == (None, "running")
    found.hear("b", beat(sent=1.0, state="failing", detail="no", refused=4), 1.0)
    found.hear("c", beat(sent=2.0, state="ready", detail="yes", refused=2), 2.0)
    assert (found.state, found.detail, found.refused) == ("failing", "no", 4)
    found.hear("b", beat(sent=3.0, detail="well again"), 3.0)
    assert (found.state, found.detail, found.refused) == ("running", "well again", 2)


@pytest.mark.parametrize(
    ("times", "rate"),
    [
        ((0.24,), 0.0),
        ((0.25,), 40.0),
        ((0.25, 0.49), 40.0),
        ((0.25, 0.5), 40.0),
        ((1.0, 2.0, 20.0), 0.0),
        ((5.0, 10.0), 2.0),
    ],
)
def test_steps_a_second_are_told_by_samples_a_quarter_of_a_second_apart(times: tuple[float, ...], rate: float) -> None:
    """Ten steps from one heartbeat to the next; samples of more than ten seconds ago are left out."""
    found = service()
    for number, at in enumerate(times, 1):
        found.hear("a", beat(10 * number, sent=at), at)
    assert found.steps_per_second() == pytest.approx(rate)


class Look:
    """A fleet that is looked at, and a clock that the test moves."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.broker = MemoryBroker()
        self.bus = Bus(MemoryTransport(self.broker), "fleet")
        self.fleet = FleetOverview(Bus(MemoryTransport(self.broker), "fleet"), clock=lambda: self.now)

    def heard(self, robot: str, **changes: Any) -> None:
        self.bus.publish(HEALTH, robot, beat(sent=self.now, **changes), changes.get("service", "s"))
        self.fleet.listen(0.0)


@pytest.mark.parametrize(("silent", "newer", "replaced"), [(1.5, True, False), (1.6, True, True), (1.6, False, False)])
def test_a_process_was_replaced_where_it_is_silent_and_another_of_its_service_was_heard_since(
    silent: float, newer: bool, replaced: bool
) -> None:
    look = Look()
    if not newer:
        look.heard("r", pid=2)
        look.now += 0.1
    look.heard("r", pid=1)
    look.now += 0.5
    if newer:
        look.heard("r", pid=2)
    look.heard("r", pid=3, service="another")
    look.now = look.fleet.services["s", 1].at + silent
    assert look.fleet.replaced(look.fleet.services["s", 1]) is replaced


@pytest.mark.parametrize(("after", "known"), [(300.0, True), (300.1, False)])
def test_who_was_silent_for_five_minutes_has_left(after: float, known: bool) -> None:
    look = Look()
    assert look.fleet.nobody
    look.heard("r")
    assert not look.fleet.nobody
    look.now += after
    look.fleet.listen(0.0)
    assert ("r" in look.fleet.robots) is known
    assert (("s", 1) in look.fleet.services) is known


@pytest.mark.parametrize(("after", "served"), [(5.0, ["a", "b"]), (5.1, ["b"])])
def test_a_robot_of_which_a_service_tells_nothing_for_five_seconds_is_not_served_by_it(
    after: float, served: list[str]
) -> None:
    look = Look()
    look.heard("a")
    look.now += after
    look.heard("b")
    assert look.fleet.services["s", 1].robots == served


def test_the_robot_s_own_heartbeat_is_no_service_s_and_that_of_nobody_no_robot_s() -> None:
    look = Look()
    look.heard("r", service="robot")
    look.heard("-", service="filter")
    assert set(look.fleet.robots) == {"r"}
    assert set(look.fleet.services) == {("filter", 1)}
    look.fleet.hear(Received(STATE, "q", state_of(), b"", "key", look.now))
    assert set(look.fleet.robots) == {"q", "r"}
    assert look.fleet.refused == 0


def state_of() -> StateMessage:
    stamp: dict[str, Any] = {"epoch": 7, "tick": 1, "robot_time": 0.05, "publish_time": 0.0}
    return StateMessage(**{**stamp, **_STATE, "period": 0.05})


def test_for_one_robot_the_heartbeats_of_services_that_serve_none_are_heard_as_well() -> None:
    broker = MemoryBroker()
    bus = Bus(MemoryTransport(broker), "fleet")
    fleet = FleetOverview(Bus(MemoryTransport(broker), "fleet"), "r", clock=lambda: 0.0)
    for number, robot in enumerate(("r", "q", "-")):
        bus.publish(HEALTH, robot, beat(service="s", pid=number), "s")
    fleet.listen(0.0)
    assert {number for _, number in fleet.services} == {0, 2}


@pytest.mark.parametrize(
    ("told", "shown"),
    [
        (None, (None, None)),  # a robot whose filter has not spoken yet
        ({"coverage": -1.0, "promised": -1.0}, (None, None)),  # it is not watched
        ({"coverage": 0.0, "promised": 0.0}, (0.0, 0.0)),
        ({"coverage": 0.97, "promised": 0.99}, (0.97, 0.99)),
        ({"coverage": -1.0, "promised": 0.99}, (None, 0.99)),
    ],
)
def test_how_often_the_margin_holds_is_told_where_it_is_watched(
    fleet: Any, told: dict[str, float] | None, shown: tuple[float | None, float | None]
) -> None:
    if told is None:
        stamp = {"epoch": 7, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
        fleet.bus.publish(STATE, "r1", StateMessage(**{**stamp, **_STATE, "period": 0.05}))
    else:
        fleet.tick("r1", state={}, verdict=told)
    fleet.overview.listen(0.0)
    (robot,) = document_of(fleet.overview)["robots"]
    assert (robot["coverage"], robot["promised"]) == shown
    assert (robot["verdict"], robot["h"]) == (("", None) if told is None else ("passed", robot["h"]))
