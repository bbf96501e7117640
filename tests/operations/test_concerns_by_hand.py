"""Each thing that may be wrong with a robot or a process alone: when it is told, and from which moment on."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import pytest
from tests.operations.conftest import _STATE, _VERDICT, LOOP

from safedpa.bus import HealthMessage, StateMessage, SurroundingsMessage, VerdictMessage
from safedpa.bus.overview.concerns import _about_process, concerns_of
from safedpa.bus.overview.robot import RobotOverview
from safedpa.bus.overview.service import ServiceOverview
from safedpa_services.command_line import stop_orders

NOW = 200.0


def stamp(tick: int = 1000) -> dict[str, Any]:
    return {"epoch": 7, "tick": tick, "robot_time": 0.05 * tick, "publish_time": 0.0}


def state_of(**changes: Any) -> StateMessage:
    return StateMessage(**{**stamp(), **_STATE, "period": 0.05, **changes})


def verdict_of(**changes: Any) -> VerdictMessage:
    return VerdictMessage(**{**stamp(), **_VERDICT, **changes})


def beat(service: str, **changes: Any) -> HealthMessage:
    return HealthMessage(**{**stamp(), "service": service, "pid": 1, "state": "running", "steps": 1, **changes})


def robot_of(**changes: Any) -> RobotOverview:
    """A robot about which nothing is to be told, but for the changes; what it said is 0.1 s old."""
    health = {service: (beat(service, model="a"), NOW - 0.1) for service in (*LOOP, "robot")}
    robot = RobotOverview("r1", since=0.0, state=state_of(), state_at=NOW - 0.1, verdict=verdict_of(), health=health)
    robot.verdict_at = NOW - 0.1
    return dataclasses.replace(robot, **{**changes, "health": {**health, **changes.get("health", {})}})


def told_of(robot: RobotOverview) -> list[tuple[str, str]]:
    return [(concern.level, concern.sentence) for concern in concerns_of(robot, NOW)]


def test_of_a_robot_with_which_all_is_well_nothing_is_told() -> None:
    assert told_of(robot_of()) == []


@pytest.mark.parametrize(
    ("age", "period", "lost"), [(1.4, 0.05, False), (1.6, 0.05, True), (4.9, 1.0, False), (5.1, 1.0, True)]
)
@pytest.mark.parametrize("which", ["state", "verdict"])
def test_a_state_or_a_verdict_is_missed_after_a_second_and_a_half_or_five_periods(
    which: str, age: float, period: float, lost: bool
) -> None:
    robot = robot_of(state=state_of(period=period), **{f"{which}_at": NOW - age})
    sentence = {"state": "alive, but it tells no state", "verdict": "no verdict: nobody filters"}[which]
    assert told_of(robot) == ([("trouble", sentence)] if lost else [])


def test_before_the_first_state_or_verdict_each_is_missed() -> None:
    assert told_of(robot_of(state=None)) == [("trouble", "alive, but it tells no state")]
    assert told_of(robot_of(verdict=None)) == [("trouble", "no verdict: nobody filters")]


@pytest.mark.parametrize(
    ("state", "silent", "ended"),
    [("braked", 0.6, True), ("braked", 0.4, False), ("running", 0.6, False), ("braked", 90.0, True)],
)
def test_a_robot_that_braked_and_fell_silent_has_ended_in_order(state: str, silent: float, ended: bool) -> None:
    robot = robot_of(state_at=NOW - silent, health={"robot": (beat("robot", state=state), NOW - silent)})
    assert (told_of(robot) == [("attention", "ended in order")]) is ended


def test_who_never_said_goodbye_is_silent() -> None:
    robot = robot_of(state_at=NOW - 9.0, health={"robot": (beat("robot"), NOW - 9.0)})
    assert told_of(robot)[0] == ("trouble", "silent for 9 s")
    nobody = robot_of(state_at=NOW - 9.0)
    del nobody.health["robot"]
    assert told_of(nobody)[0] == ("trouble", "silent for 9 s")


@pytest.mark.parametrize(
    ("status", "h", "told"),
    [
        ("passed", 0.1, []),
        ("passed", 0.0, []),
        ("passed", -0.01, ["unsafe now: h -0.010"]),
        ("violated", 0.1, ["unsafe now: h +0.100"]),  # of the next state it is below 0
        ("violated", -0.01, ["unsafe now: h -0.010"]),
        ("disabled", -0.01, ["the filter is switched off"]),
    ],
)
def test_it_is_unsafe_where_h_is_below_zero_or_will_be(status: str, h: float, told: list[str]) -> None:
    assert told_of(robot_of(verdict=verdict_of(status=status, h_now=h))) == [("trouble", line) for line in told]


@pytest.mark.parametrize(
    ("tick", "coverage", "told"),
    [(10_000, 0.9, True), (3, 0.9, False), (10_000, 0.99, False), (10_000, -1.0, False), (10_000, 0.0, True)],
)
def test_a_margin_that_holds_less_than_promised_is_told_of_steps_enough(tick: int, coverage: float, told: bool) -> None:
    verdict = verdict_of(tick=tick, coverage=coverage, promised=0.99)
    assert [level for level, _ in told_of(robot_of(verdict=verdict))] == ["attention"] * told


@pytest.mark.parametrize(
    ("status", "now", "told"),
    [("fallback", "passed", True), ("fallback", "fallback", False), ("relaxed", "passed", True),
     ("relaxed", "fallback", False), ("violated", "passed", True), ("corrected", "passed", False)],
)  # fmt: skip
def test_what_happened_of_late_is_told_unless_it_falls_back_now(status: str, now: str, told: bool) -> None:
    robot = robot_of(verdict=verdict_of(status=now))
    robot.recent_verdicts.add(status, NOW - 1.0)
    robot.recent_verdicts.add("passed", NOW - 1.0)
    assert any(line.startswith("50.0 % of the last verdicts") for _, line in told_of(robot)) is told


@pytest.mark.parametrize(("late", "of", "level"), [(0, 100, None), (1, 1000, "attention"), (30, 100, "trouble")])
def test_late_ticks_are_worth_a_look_and_many_of_them_trouble(late: int, of: int, level: str | None) -> None:
    robot = robot_of()
    for number in range(of):
        robot.recent_ticks.add("watchdog" if number < late else "filter", NOW - 1.0)
    assert [how for how, line in told_of(robot) if "were late" in line] == ([level] if level else [])


@pytest.mark.parametrize(("age", "told"), [(1.4, []), (1.6, ["policy: silent for 2 s"])])
def test_a_service_is_silent_after_a_second_and_a_half(age: float, told: list[str]) -> None:
    assert [line for _, line in told_of(robot_of(health={"policy": (beat("policy", model="a"), NOW - age)}))] == told


@pytest.mark.parametrize(("models", "told"), [("aaa", 0), ("aab", 1), ("aa", 0), ("a b", 1), ("a a", 0)])
def test_services_that_use_different_models_are_told_and_those_that_tell_none_do_not_count(
    models: str, told: int
) -> None:
    robot = robot_of()
    for service, model in zip(LOOP, models.ljust(3), strict=True):
        robot.health[service] = (beat(service, model=model.strip()), NOW)
    assert len([line for _, line in told_of(robot) if "not all use one model" in line]) == told


def test_what_is_amiss_with_sensors_is_trouble_and_what_was_ordered_worth_a_look() -> None:
    seen = SurroundingsMessage(
        **stamp(), points=(), movers=(), hidden=(), ages=(), amiss=("laser: blind",), ordered="source rear off, by Ada"
    )
    assert told_of(robot_of(seen=seen)) == [
        ("trouble", "laser: blind"), ("attention", "switched: source rear off, by Ada"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "age", "replaced", "changes", "told"),
    [
        ("recorder", 0.1, False, {"free_bytes": 10**11}, ""),
        ("recorder", 1.4, False, {"free_bytes": 10**11}, ""),
        ("recorder", 1.6, False, {}, "trouble: recorder: silent for 2 s"),
        ("recorder", 1.6, True, {}, ""),
        ("dashboard", 1.6, False, {}, "attention: dashboard: silent for 2 s"),
        ("dashboard", 1.6, True, {}, ""),
        ("policy", 1.6, False, {}, ""),  # told of each robot that it serves
        ("policy", 1.6, True, {}, ""),
        ("policy", 0.1, False, {"state": "failing"}, ""),
        ("dashboard", 0.1, False, {"state": "failing", "detail": "no disk"}, "trouble: dashboard: failing, no disk"),
        ("recorder", 0.1, False, {"free_bytes": 0}, ""),  # not told
        ("recorder", 0.1, False, {"free_bytes": 5_000_000}, "attention: recorder: 5 MB of disk left"),
        ("dashboard", 0.1, False, {"free_bytes": 5_000_000}, ""),
        ("router", 0.1, False, {"refused": 0}, ""),
        ("router", 0.1, False, {"refused": 7}, "attention: router: 7 refused or denied"),
        ("dashboard", 0.1, False, {"refused": 7}, ""),
        ("policy", 0.1, False, {"refused": 7}, ""),
    ],
)
def test_what_is_told_of_a_process(name: str, age: float, replaced: bool, changes: dict[str, Any], told: str) -> None:
    message = beat(name, **changes)
    service = ServiceOverview(name, 1, message, NOW - age, {"-": (message, NOW - age)})
    fleet: Any = SimpleNamespace(replaced=lambda _: replaced)
    said = [f"{concern.level}: {concern.sentence}" for concern in _about_process(service, NOW, fleet)]
    assert said == ([told] if told else [])


def test_a_fleet_of_which_robots_or_processes_alone_were_heard_is_somebody(fleet: Any) -> None:
    assert fleet.overview.nobody
    fleet.beat("recorder")
    fleet.overview.listen(0.0)
    assert (list(fleet.overview.robots), fleet.overview.nobody) == ([], False)
    fleet.overview.services.clear()
    fleet.drive(1, silent=(*LOOP, "recorder"))
    fleet.overview.services.clear()
    assert (list(fleet.overview.robots), fleet.overview.nobody) == (["r1"], False)


@pytest.mark.parametrize(
    ("do", "status", "speed", "corridor", "does"),
    [
        ("go", "passed", 1.0, False, "may drive"),
        ("go", None, 0.0, False, "may drive"),
        ("go", "stopped", 0.0, False, "stopped by an order of its own"),
        ("stop", "stopped", 0.0, False, "stands"),
        ("stop", "passed", 0.02, False, "stands"),
        ("stop", "passed", -0.02, False, "stands"),
        ("stop", "passed", 0.5, False, "still drives, +0.50 m/s"),
        ("stop", "passed", -0.5, False, "still drives, -0.50 m/s"),
        ("stop", None, 0.5, False, "still drives, +0.50 m/s"),
        ("stop", "stopped", 0.5, False, "still brakes, +0.50 m/s"),
        ("stop", "stopped", -0.5, False, "still brakes, -0.50 m/s"),
        ("stop", "stopped", 9.0, True, "keeps its corridor without the policy; it has no stand"),
        ("stop", "passed", 0.0, True, "still obeys the policy"),
    ],
)
def test_what_a_robot_does_after_an_order(do: str, status: str | None, speed: float, corridor: bool, does: str) -> None:
    state = state_of(values=(0.0, 0.0, 0.0, speed), corridor=(0.1, 0.1) if corridor else ())
    verdict = None if status is None else verdict_of(status=status)
    assert stop_orders._does(robot_of(state=state, verdict=verdict), do) == does
