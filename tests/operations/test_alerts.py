"""What may be wrong with a robot or a process: when it is reported, at which level, and from which moment on."""

import dataclasses
from typing import Any

import pytest
from tests.messages import stamp
from tests.operations.conftest import LOOP, STATE_FIELDS, VERDICT_FIELDS

from safedpa.bus import HealthMessage, StateMessage, SurroundingsMessage, VerdictMessage
from safedpa.bus.monitor import fleet_alerts
from safedpa.bus.monitor.alerts import robot_alerts
from safedpa.bus.monitor.fleet_state import RobotOverview, ServiceOverview

NOW = 200.0
SILENT = ("trouble", "silent for 9 s")


def state_of(**changes: Any) -> StateMessage:
    return StateMessage(**{**stamp(1000, epoch=7), **STATE_FIELDS, "period": 0.05, **changes})


def verdict_of(**changes: Any) -> VerdictMessage:
    return VerdictMessage(**{**stamp(1000, epoch=7), **VERDICT_FIELDS, **changes})


def beat(service: str, **changes: Any) -> HealthMessage:
    return HealthMessage(
        **{**stamp(1000, epoch=7), "service": service, "pid": 1, "state": "running", "steps": 1, **changes}
    )


def robot_of(**changes: Any) -> RobotOverview:
    """A healthy robot, but for the changes; its messages are 0.1 s old."""
    health = {service: (beat(service, model="a"), NOW - 0.1) for service in (*LOOP, "robot")}
    robot = RobotOverview("r1", since=0.0, state=state_of(), state_at=NOW - 0.1, verdict=verdict_of(), health=health)
    robot.verdict_at = NOW - 0.1
    return dataclasses.replace(robot, **{**changes, "health": {**health, **changes.get("health", {})}})


def concerns(robot: RobotOverview) -> list[tuple[str, str]]:
    return [(concern.level, concern.sentence) for concern in robot_alerts(robot, NOW)]


def test_a_healthy_robot_raises_no_concern() -> None:
    assert concerns(robot_of()) == []


LOST = {
    "state": ("state_at", "alive, but sends no state"),
    "verdict": ("verdict_at", "no verdict, although the filter gets states"),
}


@pytest.mark.parametrize(
    ("age", "period", "lost"), [(1.4, 0.05, False), (1.6, 0.05, True), (4.9, 1.0, False), (5.1, 1.0, True)]
)
@pytest.mark.parametrize("which", LOST)
def test_a_state_or_a_verdict_is_missed_after_a_second_and_a_half_or_five_periods(which, age, period, lost):
    field, sentence = LOST[which]
    robot = robot_of(state=state_of(period=period), **{field: NOW - age})
    assert concerns(robot) == ([("trouble", sentence)] if lost else [])
    never = robot_of(state=None) if which == "state" else robot_of(verdict=None)
    assert concerns(never) == [("trouble", sentence)]


def test_a_missing_verdict_has_its_reason() -> None:
    robot = robot_of(state_at=NOW - 9.0, verdict_at=NOW - 9.0)
    assert ("trouble", "no verdict: the filter gets no state") in concerns(robot)
    robot = robot_of(verdict=None)
    del robot.health["safety_filter"]
    assert ("trouble", "no verdict: the robot has no safety filter") in concerns(robot)


@pytest.mark.parametrize(
    ("state", "silent", "ended"),
    [("braked", 0.6, True), ("braked", 0.4, False), ("running", 0.6, False), ("braked", 90.0, True)],
)
def test_a_robot_that_braked_and_fell_silent_has_ended_in_order(state: str, silent: float, ended: bool) -> None:
    robot = robot_of(state_at=NOW - silent, health={"robot": (beat("robot", state=state), NOW - silent)})
    assert (concerns(robot) == [("attention", "was shut down")]) is ended


def test_a_robot_that_fell_silent_without_braking_is_trouble() -> None:
    robot = robot_of(state_at=NOW - 9.0, health={"robot": (beat("robot"), NOW - 9.0)})
    assert concerns(robot)[0] == SILENT
    del robot.health["robot"]
    assert concerns(robot)[0] == SILENT


@pytest.mark.parametrize(
    ("status", "h", "reported"),
    [
        ("passed", 0.1, []),
        ("passed", 0.0, []),
        ("passed", -0.01, ["unsafe now: h -0.010"]),
        ("violated", 0.1, ["unsafe now: h +0.100"]),  # of the next state it is below 0
        ("violated", -0.01, ["unsafe now: h -0.010"]),
        ("disabled", -0.01, ["the filter is switched off"]),
    ],
)
def test_a_robot_is_unsafe_where_h_is_or_will_be_below_zero(status: str, h: float, reported: list[str]) -> None:
    assert concerns(robot_of(verdict=verdict_of(status=status, h_now=h))) == [("trouble", line) for line in reported]


@pytest.mark.parametrize(
    ("tick", "coverage", "reported"),
    [(10_000, 0.9, True), (3, 0.9, False), (10_000, 0.99, False), (10_000, -1.0, False), (10_000, 0.0, True)],
)
def test_a_margin_that_covers_less_than_promised_is_reported_after_enough_steps(tick, coverage, reported):
    verdict = verdict_of(tick=tick, coverage=coverage, promised=0.99)
    sentence = f"the margin held in {100 * coverage:.1f} % of the steps, promised 99.0 %"
    assert concerns(robot_of(verdict=verdict)) == [("attention", sentence)] * reported


@pytest.mark.parametrize(
    ("status", "now", "reported"),
    [("fallback", "passed", True), ("fallback", "fallback", False), ("relaxed", "passed", True),
     ("relaxed", "fallback", False), ("violated", "passed", True), ("corrected", "passed", False)],
)  # fmt: skip
def test_recent_verdicts_are_reported_unless_the_robot_falls_back_now(status: str, now: str, reported: bool) -> None:
    robot = robot_of(verdict=verdict_of(status=now))
    robot.recent_verdicts.add(status, NOW - 1.0)
    robot.recent_verdicts.add("passed", NOW - 1.0)
    lines = [f"50.0 % of the last verdicts {status}"] if reported else []
    assert [line for _, line in concerns(robot) if "of the last verdicts" in line] == lines


@pytest.mark.parametrize(("late", "of", "level"), [(0, 100, None), (1, 1000, "attention"), (30, 100, "trouble")])
def test_late_ticks_deserve_attention_and_many_of_them_are_trouble(late: int, of: int, level: str | None) -> None:
    robot = robot_of()
    for number in range(of):
        robot.recent_ticks.add("watchdog" if number < late else "filter", NOW - 1.0)
    assert [how for how, line in concerns(robot) if "were late" in line] == ([level] if level else [])


@pytest.mark.parametrize(("age", "reported"), [(1.4, []), (1.6, [("trouble", "policy: silent for 2 s")])])
def test_a_service_is_silent_after_a_second_and_a_half(age: float, reported: list[tuple[str, str]]) -> None:
    assert concerns(robot_of(health={"policy": (beat("policy", model="a"), NOW - age)})) == reported


@pytest.mark.parametrize(("models", "differ"), [("aaa", 0), ("aab", 1), ("aa ", 0), ("a b", 1), ("a a", 0)])
def test_services_with_different_models_are_trouble_and_those_that_report_none_do_not_count(models: str, differ: int):
    robot = robot_of()
    for service, model in zip(LOOP, models, strict=True):
        robot.health[service] = (beat(service, model=model.strip()), NOW)
    assert [level for level, line in concerns(robot) if "services use different models" in line] == ["trouble"] * differ


def test_a_wrong_sensor_is_trouble_and_a_switched_one_deserves_attention() -> None:
    seen = SurroundingsMessage(
        **stamp(1000, epoch=7),
        points=(),
        movers=(),
        hidden=(),
        ages=(),
        problems=("laser: blind",),
        ordered="source rear off, by Ada",
    )
    assert concerns(robot_of(seen=seen)) == [
        ("trouble", "laser: blind"), ("attention", "switched: source rear off, by Ada"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "age", "replaced", "changes", "reported"),
    [
        ("recorder", 1.4, False, {"free_bytes": 10**11}, ""),
        ("recorder", 1.6, False, {}, "trouble: recorder: silent for 2 s"),
        ("recorder", 1.6, True, {}, ""),
        ("dashboard", 1.6, False, {}, "attention: dashboard: silent for 2 s"),
        ("dashboard", 1.6, True, {}, ""),
        ("policy", 1.6, False, {}, ""),  # reported with each robot that it serves
        ("policy", 0.1, False, {"state": "failing"}, ""),
        ("dashboard", 0.1, False, {"state": "failing", "detail": "no disk"}, "trouble: dashboard: failing, no disk"),
        ("recorder", 0.1, False, {"free_bytes": 0}, ""),  # unknown
        ("recorder", 0.1, False, {"free_bytes": 5_000_000}, "attention: recorder: 5 MB of disk left"),
        ("recorder", 0.1, False, {"free_bytes": 2_000_000_000}, ""),
        ("dashboard", 0.1, False, {"free_bytes": 5_000_000}, ""),
        ("router", 0.1, False, {"refused": 0}, ""),
        ("router", 0.1, False, {"refused": 7}, "attention: router: 7 messages refused or denied"),
        (
            "router",
            0.1,
            False,
            {"detail": "twice: recorder"},
            "attention: two processes use the certificate of recorder: the later is cut off each second; end one of "
            "them",
        ),
        ("dashboard", 0.1, False, {"refused": 7}, ""),
    ],
)
def test_concerns_about_a_process(fleet, name, age, replaced, changes, reported):
    for pid, heard, message in ((1, fleet.now - age, beat(name, **changes)), (2, fleet.now, beat(name, pid=2))):
        if pid == 1 or replaced:
            fleet.overview.services[name, pid] = ServiceOverview(name, pid, message, heard, {"-": (message, heard)})
    found = [f"{own.level}: {own.sentence}" for own in fleet_alerts(fleet.overview) if own.service == name]
    assert found == ([reported] if reported else [])
