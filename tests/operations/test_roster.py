"""Who should be there: missing is trouble until it returns or is dismissed, for everything that observes a fleet."""

import dataclasses
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.messages import state_of, verdict_of
from tests.operations.conftest import LOOP

from safedpa.bus import RosterEntry
from safedpa.bus.monitor import MeasurementTimes, fleet_alerts
from safedpa_services.command_line.status import document_of
from safedpa_services.metrics.exporter import FleetCollector

ROBOT = RosterEntry(kind="robot", name="r1")
SERVICES = tuple(RosterEntry(kind="service", name=name) for name in (*LOOP, "recorder"))


def trouble(fleet: Any) -> list[str]:
    return [f"{alert.robot} {alert.sentence}" for alert in fleet_alerts(fleet.overview) if alert.level == "trouble"]


def metric(fleet: Any, name: str, *labels: str) -> float | None:
    for family in FleetCollector(fleet.overview).collect():
        for sample in family.samples:
            if sample.name == name and tuple(sample.labels.values())[: len(labels)] == labels:
                return float(sample.value)
    return None


def pass_time(fleet: Any, seconds: float, **about: Any) -> None:
    """Only the supervisor is heard meanwhile; ``about``: fields of the robot's entry."""
    for _ in range(round(2 * seconds)):
        fleet.now += 0.5
        fleet.list_members(dataclasses.replace(ROBOT, **about), *SERVICES)


@pytest.mark.parametrize("seconds", [2.0, 20.0, 300.0, 4000.0])
def test_a_silent_robot_is_trouble_everywhere_for_as_long_as_it_is_silent(fleet: Any, seconds: float) -> None:
    fleet.list_members(ROBOT, *SERVICES)
    fleet.drive(1)
    assert document_of(fleet.overview)["healthy"]
    assert metric(fleet, "safedpa_missing", "robot", "r1") == 0.0
    pass_time(fleet, seconds)
    assert f"r1 silent for {seconds:.0f} s" in trouble(fleet)
    assert not document_of(fleet.overview)["healthy"]
    assert metric(fleet, "safedpa_missing", "robot", "r1") == 1.0
    assert (metric(fleet, "safedpa_robot_up", "r1"), metric(fleet, "safedpa_robot_healthy", "r1")) == (0.0, 0.0)
    assert metric(fleet, "safedpa_barrier_value", "r1") is None, "an old value is not exported as the present one"
    assert metric(fleet, "safedpa_message_age_seconds", "r1", "verdict") == pytest.approx(seconds, abs=0.5)


def test_an_observer_that_joins_later_knows_who_is_missing_and_for_how_long(fleet: Any) -> None:
    pass_time(fleet, 3.0, silent_for=95.0)
    assert not document_of(fleet.overview)["healthy"]
    assert "r1 missing, heard last 95 s ago" in trouble(fleet)
    assert " policy: not heard yet" in trouble(fleet)
    assert metric(fleet, "safedpa_robot_up", "r1") == 0.0


def test_a_return_clears_the_trouble_and_keeps_the_incident(fleet: Any) -> None:
    fleet.list_members(ROBOT)
    fleet.drive(1)
    fleet.now += 60.0
    fleet.list_members(ROBOT)
    assert trouble(fleet)
    fleet.drive(1)
    fleet.list_members(ROBOT)
    assert trouble(fleet) == []
    (incident,) = [each for each in document_of(fleet.overview)["incidents"] if each["kind"] == "robot"]
    assert incident["seconds"] == pytest.approx(60.0, abs=0.5)
    assert metric(fleet, "safedpa_incidents_total", "robot", "r1") == 1.0


def test_a_dismissal_clears_the_trouble_until_the_robot_returns_and_leaves_again(fleet: Any) -> None:
    fleet.list_members(ROBOT)
    fleet.drive(1)
    fleet.list_members(ROBOT, dismisses=("r1",), who="Ann")
    assert trouble(fleet) == [], "a robot that is there cannot be dismissed"
    fleet.now += 60.0
    fleet.list_members(dismisses=("r1", "adaptation", "policy", "safety_filter", "recorder"), who="Ann")
    for service in LOOP:
        fleet.beat(service, "r1")  # services go on to report a robot that is silent
    pass_time(fleet, 1.0)
    assert trouble(fleet) == []
    assert metric(fleet, "safedpa_robot_up", "r1") is None, "no alert for a robot that is not expected"
    assert any("dismissed by Ann" in alert.sentence for alert in fleet_alerts(fleet.overview))
    fleet.drive(1)
    pass_time(fleet, 3.0)
    assert "r1 silent for 3 s" in trouble(fleet)


def test_a_silent_supervisor_is_trouble_until_it_ends_in_order_or_a_later_run_has_its_robots(fleet: Any) -> None:
    fleet.list_members(ROBOT, *SERVICES)
    fleet.drive(1, 5.0, silent=("supervisor",))
    assert trouble(fleet) == [" supervisor: silent for 5 s; nothing restarts a process that ends"]
    fleet.list_members(ROBOT, source="later run")
    assert trouble(fleet) == []
    fleet.drive(1, 3.0, silent=("supervisor",))
    assert "supervisor: silent" in trouble(fleet)[0]
    fleet.list_members(source="later run", ended=True)
    assert trouble(fleet) == []


def test_after_a_run_that_ended_in_order_nothing_of_it_is_missed(fleet: Any) -> None:
    fleet.list_members(ROBOT, *SERVICES)
    fleet.drive(1)
    fleet.list_members(ended=True)
    fleet.drive(1)
    assert "r1" in fleet.overview.robots, "it still brakes"
    fleet.now += 3.0
    fleet.overview.listen(0.0)
    assert trouble(fleet) == []
    assert not fleet.overview.robots
    assert not fleet.overview.services


def test_supervised_processes_without_any_roster_are_trouble(fleet: Any) -> None:
    fleet.drive(1)
    fleet.beat("recorder", supervised=True, acknowledged=1)
    fleet.overview.listen(0.0)
    assert trouble(fleet) == [" no supervisor: nothing restarts a process that ends"]


def test_what_is_not_restarted_any_more_is_trouble_with_its_cause(fleet: Any) -> None:
    fleet.list_members(RosterEntry(kind="service", name="dashboard", restarts=8, cause="no disk", given_up=True))
    fleet.beat("dashboard")
    fleet.overview.listen(0.0)
    assert trouble(fleet) == [" dashboard: missing, heard last 0 s ago; no disk; it is not restarted any more"]


@given(
    offset=st.floats(-1e6, 1e6),
    delays=st.lists(st.floats(0.0, 9.0), min_size=2, max_size=30),
)
def test_ages_count_from_the_measurement_whatever_the_clocks_and_the_delays(offset: float, delays: list[float]) -> None:
    times, arrival = MeasurementTimes(), 0.0
    least = float("inf")
    for tick, delay in enumerate(delays):
        measured = 0.05 * tick
        arrival, least = max(arrival, measured + delay), min(least, max(arrival, measured + delay) - measured)
        state = state_of(tick=tick, publish_time=measured + offset)
        found = times.of(state, arrival)
        # The delay of the fastest message is all that cannot be known; clocks may drift by 200 ppm.
        assert found == pytest.approx(min(arrival, measured + least), abs=2e-4 * arrival + 1e-6)
        assert times.of(verdict_of("passed", tick=tick), arrival + 3.0) == found


@pytest.mark.parametrize("publish_time", [0.0, 5.0])
def test_without_an_advancing_clock_the_arrival_counts(publish_time: float) -> None:
    times = MeasurementTimes()
    for tick in range(3):
        assert times.of(state_of(tick=tick, publish_time=publish_time), 10.0 * tick) == 10.0 * tick
