"""Four robots with different loads drive for a minute: no collision, every one reaches goals, none is stationary."""

import time
from typing import Any

import pytest
from fleet_containers import LOADS, Fleet, Watch, run

pytestmark = pytest.mark.fleet

DRIVE_SECONDS = 60.0
STUCK_SECONDS = 20.0
STUCK_METRES = 0.3
"""Who stands goes nowhere; who backs off with a box does 6 cm a second: of scene 1 the slowest 20 s are 0.8 to 5.5 m,
as the time from sense to act will have it."""
LONGEST_SECONDS = 180.0
"""Until every robot reached a goal: on a machine that is busy with other work they brake often."""


def test_every_container_starts_and_every_robot_is_driven(fleet: Fleet, watch: Watch, rows: list[tuple[str, ...]]):
    began = time.monotonic()

    def driven(reported: dict[str, Any]) -> bool:
        robots = reported["robots"]
        return set(robots) == set(fleet.robots) and all(robot["run_ticks"] > 0 for robot in robots.values())

    assert watch.until(driven, 60.0), "not every robot was driven within a minute of its start"
    rows.append(("start", f"four robots driven {time.monotonic() - began:.1f} s after the last container was started"))


def test_the_filter_in_its_container_is_compiled(fleet: Fleet, rows: list[tuple[str, ...]]) -> None:
    """From source a decision takes twice as long; and what compiled it did not come along."""
    asked = "import shutil; from safedpa.compiled import *; print(compiled_modules() == MODULES, shutil.which('gcc'))"
    notice = run("docker", "exec", fleet.container("safety_filter"), "python", "-c", asked).stdout.strip()
    assert notice == "True None"
    rows.append(("the filter's innermost modules", "compiled"))


def test_a_minute_without_collision_in_which_every_robot_reaches_goals(fleet, watch, rows):
    before = watch.now()
    time.sleep(DRIVE_SECONDS - STUCK_SECONDS)
    middle = watch.now()
    time.sleep(STUCK_SECONDS)

    def everyone_at_a_goal(reported: dict[str, Any]) -> bool:
        return all(robot["goals"] > before["robots"][name]["goals"] for name, robot in reported["robots"].items())

    watch.until(everyone_at_a_goal, LONGEST_SECONDS - DRIVE_SECONDS)
    after = watch.now()
    seconds = after["at"] - before["at"]
    for name, load in zip(fleet.robots, LOADS, strict=True):
        first, last = before["robots"][name], after["robots"][name]
        goals = last["goals"] - first["goals"]
        ticks = sum(last["applied"].values()) - sum(first["applied"].values())
        braked = last["applied"].get("watchdog", 0) - first["applied"].get("watchdog", 0)
        distance = last["travelled"] - first["travelled"]
        text = f"{goals} goals, {distance:.0f} m, braked itself in {braked} of {ticks} periods"
        rows.append((f"{seconds:.0f} s of {load}", f"{text}, {last['collisions']} collisions"))
        assert last["collisions"] == 0, name
        assert goals >= 1, f"{name} with {load} reached no goal in {seconds:.0f} s"
        assert last["travelled"] - middle["robots"][name]["travelled"] > STUCK_METRES, f"{name} with {load} is stuck"
        assert last["foreign"] == 0
        assert last["checked"] > 0.5 * ticks
