"""What a listener counts of a fleet: the last seconds, heartbeats, replaced processes and robots that left."""

from typing import Any

import pytest
from tests.messages import health_of, stamp, state_of
from tests.operations.conftest import LOOP

from safedpa.bus import Bus, HealthMessage, MemoryBroker, MemoryTransport, ReceivedMessage
from safedpa.bus.messages.messages import RosterEntry, RosterMessage
from safedpa.bus.messages.topics import HEALTH, NO_ROBOT, ROSTER, STATE
from safedpa.bus.monitor.fleet_state import FleetOverview, ServiceOverview, SlidingCounter
from safedpa_services.command_line.status import document_of


def beat(steps: int = 0, stale: int = 0, sent: float = 0.0, **changes: Any) -> HealthMessage:
    return health_of(**{"service": "s", "pid": 1, **changes}, steps=steps, stale=stale, publish_time=sent)


def service(**changes: Any) -> ServiceOverview:
    first = beat(**changes)
    found = ServiceOverview("s", 1, first, 0.0)
    found.hear("a", first, 0.0)
    return found


def test_counts_are_those_of_the_last_ten_seconds_in_slices_of_half_a_second() -> None:
    recent = SlidingCounter()
    for at in (0.0, 0.4, 0.5, 3.0):
        recent.add("late", at)
    recent.add("fine", 3.0)
    assert recent.counts(9.9) == {"late": 4, "fine": 1}
    assert recent.share("late", 9.9) == 0.8
    assert recent.counts(10.0) == {"late": 2, "fine": 1}
    assert recent.counts(10.5) == {"late": 1, "fine": 1}
    assert recent.share("late", 13.0) == 0.0


@pytest.mark.parametrize(
    ("now", "rate"), [(0.0, 0.0), (0.49, 0.0), (0.5, 4.0), (2.0, 1.0), (9.0, 2.0 / 9.0), (11.0, 0.0)]
)
def test_a_rate_is_reported_from_half_a_second_on(now: float, rate: float) -> None:
    recent = SlidingCounter()
    assert recent.rate(now) == 0.0
    for at in (0.0, 0.1):
        recent.add("tick", at)
    assert recent.rate(now) == pytest.approx(rate)


def test_after_more_than_ten_seconds_a_rate_is_that_of_the_last_ten() -> None:
    recent = SlidingCounter()
    for second in range(31):
        recent.add("tick", float(second))
    assert recent.rate(30.0) == pytest.approx(1.0)


@pytest.mark.parametrize(("sent", "steps"), [(4.9, 10), (5.0, 12), (5.1, 12)])
def test_a_heartbeat_that_arrives_after_a_newer_one_is_ignored(sent: float, steps: int) -> None:
    found = service(steps=10, sent=5.0)
    found.hear("a", beat(12, sent=sent), 1.0)
    assert (found.steps, found.at) == (steps, 1.0 if steps == 12 else 0.0)
    found.hear("b", beat(7, sent=0.0), 2.0)  # of another robot nothing newer is known
    assert (found.steps, found.at, found.robots) == (steps + 7, 2.0, ["a", "b"])


@pytest.mark.parametrize(
    ("steps", "stale", "together"), [(12, 3, (12, 3)), (2, 1, (12, 4)), (10, 2, (20, 5)), (2, 9, (12, 12))]
)
def test_counts_go_on_when_a_robot_restarts(steps: int, stale: int, together: tuple[int, int]) -> None:
    """Either count that falls is a restart."""
    found = service(steps=10, stale=3)
    found.hear("a", beat(steps, stale, 1.0), 1.0)
    assert (found.steps, found.stale) == together


def test_counts_of_a_robot_that_is_no_longer_served_remain() -> None:
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
    [((0.24,), 0.0), ((0.25,), 40.0), ((0.25, 0.49), 40.0), ((1.0, 2.0, 20.0), 0.0), ((5.0, 10.0), 2.0)],
)
def test_steps_a_second_come_from_samples_a_quarter_of_a_second_apart(times: tuple[float, ...], rate: float) -> None:
    """Ten steps from one heartbeat to the next; samples of more than ten seconds ago are left out."""
    found = service()
    for number, at in enumerate(times, 1):
        found.hear("a", beat(10 * number, sent=at), at)
    assert found.steps_per_second() == pytest.approx(rate)


class Listened:
    """A fleet, its listener, and a clock that the test moves."""

    def __init__(self, robot: str = "*") -> None:
        self.now = 1000.0
        broker = MemoryBroker()
        self.bus = Bus(MemoryTransport(broker), "fleet")
        self.fleet = FleetOverview(Bus(MemoryTransport(broker), "fleet"), robot, clock=lambda: self.now)

    def heard(self, robot: str, **changes: Any) -> None:
        self.bus.publish(HEALTH, robot, beat(sent=self.now, **changes), changes.get("service", "s"))
        self.fleet.listen(0.0)


@pytest.mark.parametrize(("silent", "newer", "replaced"), [(1.5, True, False), (1.6, True, True), (1.6, False, False)])
def test_a_silent_process_was_replaced_if_another_of_its_service_was_heard_since(silent, newer, replaced):
    listened = Listened()
    if not newer:
        listened.heard("r", pid=2)
        listened.now += 0.1
    listened.heard("r", pid=1)
    listened.now += 0.5
    if newer:
        listened.heard("r", pid=2)
    listened.heard("r", pid=3, service="another")
    listened.now = listened.fleet.services["s", 1].at + silent
    assert listened.fleet.replaced(listened.fleet.services["s", 1]) is replaced


@pytest.mark.parametrize(
    ("after", "service", "state", "known"),
    [(300.0, "robot", "braked", True), (300.1, "robot", "braked", False), (9e4, "robot", "running", True),
     (9e4, "policy", "running", True)],
)  # fmt: skip
def test_only_a_robot_that_was_shut_down_is_forgotten_after_five_minutes(after, service, state, known):
    listened = Listened()
    assert listened.fleet.is_empty
    listened.heard("r", service=service, state=state)
    assert not listened.fleet.is_empty
    listened.now += after
    listened.fleet.listen(0.0)
    assert ("r" in listened.fleet.robots) is known
    assert (("policy", 1) in listened.fleet.services) is (service == "policy")


@pytest.mark.parametrize(("after", "served"), [(5.0, ["a", "b"]), (5.1, ["b"])])
def test_a_robot_of_which_a_service_reports_nothing_for_five_seconds_is_no_longer_served(after, served):
    listened = Listened()
    listened.heard("a")
    listened.now += after
    listened.heard("b")
    assert listened.fleet.services["s", 1].robots == served


def test_a_robots_own_heartbeat_adds_no_service_and_one_without_a_robot_no_robot() -> None:
    listened = Listened()
    listened.heard("r", service="robot")
    listened.heard("-", service="filter")
    listened.fleet.hear(ReceivedMessage(STATE, "q", state_of(epoch=7, tick=1), b"", "key", listened.now))
    assert (set(listened.fleet.robots), set(listened.fleet.services)) == ({"q", "r"}, {("filter", 1)})
    assert listened.fleet.refused == 0


@pytest.mark.parametrize("robot", ["*", "r"])
def test_messages_of_a_pause_count_in_order_of_arrival(robot: str) -> None:
    listened = Listened(robot)
    entries = (RosterEntry(kind="service", name="s"), RosterEntry(kind="service", name="silent"))
    for _ in range(4):
        roster = RosterMessage(**stamp(0), source="run", entries=entries)
        listened.bus.publish(ROSTER, NO_ROBOT, roster)
        listened.bus.publish(HEALTH, "r", beat(sent=listened.now), "s")
        listened.now += 1.0
    listened.fleet.listen(0.0)
    assert [member.name for member in listened.fleet.roster.missing(listened.now)] == ["silent"]


def test_a_listener_for_one_robot_also_hears_services_that_serve_none() -> None:
    listened = Listened("r")
    for number, robot in enumerate(("r", "q", "-")):
        listened.heard(robot, pid=number)
    assert {number for _, number in listened.fleet.services} == {0, 2}


def test_robots_alone_or_processes_alone_are_a_fleet(fleet: Any) -> None:
    fleet.beat("recorder")
    fleet.overview.listen(0.0)
    assert (list(fleet.overview.robots), fleet.overview.is_empty) == ([], False)
    fleet.overview.services.clear()
    fleet.drive(1, silent=(*LOOP, "recorder"))
    fleet.overview.services.clear()
    assert (list(fleet.overview.robots), fleet.overview.is_empty) == (["r1"], False)


def test_a_robot_without_a_verdict_has_neither_status_nor_h(fleet: Any) -> None:
    fleet.bus.publish(STATE, "r1", state_of(epoch=7, tick=1))
    fleet.overview.listen(0.0)
    (robot,) = document_of(fleet.overview)["robots"]
    assert [robot[name] for name in ("coverage", "promised", "verdict", "h")] == [None, None, "", None]
