"""Which processes a loop consists of, and which of them it cannot do without."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from safedpa.errors import InputError
from safedpa_services.command_line import up
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.plan import Plan
from safedpa_services.supervisor.screen import _Page
from safedpa_services.supervisor.supervisor import Supervisor
from safedpa_sim.robots import CHANGES


def planned(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *options: str) -> Plan:
    """The plan that ``safedpa up`` makes of its options; nothing is started."""
    seen: list[Plan] = []
    summary: dict[str, Any] = {}

    def drive(plan: Plan, *_: Any, **__: Any) -> dict[str, Any]:
        seen.append(plan)
        return summary

    monkeypatch.setattr(up, "driven", drive)
    result = CliRunner().invoke(up.command, ["--json", "--out", str(tmp_path), *options])
    assert result.exception is None, result.output
    return seen[0]


def named(plan: Plan) -> dict[str, Child]:
    return {child.name: child for child in plan.services()}


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ([], True),
        (["--headless"], True),
        (["--lockstep"], True),
        (["--lockstep", "--headless"], False),
        (["--lockstep", "--headless", "--diagnosis"], True),
        (["--no-diagnosis"], False),
    ],
)
def test_the_diagnosis_runs_unless_only_a_summary_is_wanted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, options: list[str], wanted: bool
) -> None:
    children = named(planned(monkeypatch, tmp_path, *options))
    assert ("diagnosis" in children) is wanted
    assert ("workbench" in children) is (wanted and "--headless" not in options)


def test_perception_is_told_its_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "perception.toml"
    file.write_text("[perception]\nmin_points = 2\n")
    told = named(planned(monkeypatch, tmp_path, "--laser", "--perception", str(file)))["perception"].arguments
    assert told[: told.index(str(file)) + 1] == ("--perception", str(file))
    assert "--perception" not in named(planned(monkeypatch, tmp_path, "--laser"))["perception"].arguments


def test_only_what_drives_is_essential_and_has_priority(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    children = named(planned(monkeypatch, tmp_path, "--margin", "car"))
    assert {name for name, child in children.items() if "--realtime" in child.arguments} == {
        "adaptation",
        "policy",
        "safety_filter",
    }
    assert not children["diagnosis"].essential
    assert not children["workbench"].essential
    assert all(children[name].essential for name in ("adaptation", "policy", "safety_filter", "recorder"))
    words = children["diagnosis"].arguments
    for option, value in (("--margin", "car"), ("--model", "car"), ("--settings", "car")):
        assert words[words.index(option) + 1] == value
    assert words[words.index("--versions") + 1].endswith("/models"), "what was agreed on outlives the process"


def test_perception_runs_beside_a_car_with_a_laser_and_beside_no_other(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    without = planned(monkeypatch, tmp_path, "--headless")
    plan = planned(monkeypatch, tmp_path, "--headless", "--laser", "--people", "2")
    assert "perception" not in named(without)
    assert "--laser" not in without.robot_process().arguments
    assert named(plan)["perception"].essential
    assert "--realtime" in named(plan)["perception"].arguments
    assert "--laser" in plan.robot_process().arguments
    assert "--people=2" in plan.robot_process().arguments


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--people", "2"], "without --laser"),
        (["--laser", "--people", "99"], "wanted 0 to 12"),
        (["--laser", "--robot", "pendulum"], "--laser: got one for a pendulum"),
    ],
)
def test_people_and_lasers_where_there_are_none_are_refused(tmp_path: Path, options: list[str], said: str) -> None:
    result = CliRunner().invoke(up.command, ["--headless", "--out", str(tmp_path), *options])
    assert said in str(result.exception)


def test_what_changes_is_the_robot_s_affair(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert up.CHANGES == CHANGES
    robot = planned(monkeypatch, tmp_path, "--change", "hitch", "--change-after", "12").robot_process()
    at = robot.arguments.index("--change")
    assert robot.arguments[at : at + 4] == ("--change", "hitch", "--change-after", "12.0")
    assert "--change" not in planned(monkeypatch, tmp_path).robot_process().arguments


def test_a_time_of_the_change_that_cannot_be_is_refused(tmp_path: Path) -> None:
    result = CliRunner().invoke(up.command, ["--change-after", "-1", "--out", str(tmp_path)])
    assert "--change-after: got -1.0" in str(result.exception)


class DeadChild(Child):
    """Ended at once with the exit code of bad input."""

    started = 0

    def start(self) -> None:
        type(self).started += 1

    @property
    def exit_code(self) -> int | None:
        return 2


class Deaf:
    health: dict[str, Any] = {}  # noqa: RUF012

    def listen(self, wait: float) -> None:
        del wait


def test_a_diagnosis_that_cannot_be_brought_up_ends_nothing(tmp_path: Path) -> None:
    child = DeadChild("diagnosis", "none", (), tmp_path / "log", essential=False)
    robot = Child("robot", "none", (), tmp_path / "robot.log")
    turns = iter([False] * 5 + [True] * 50)
    supervisor = Supervisor([child], robot, Deaf(), lambda: next(turns), lambda: None)  # type: ignore[arg-type]
    robot.start = lambda: None  # type: ignore[method-assign]
    assert supervisor.run() == 0
    assert DeadChild.started == 1, "it is not tried again and again"


def test_a_robot_that_refuses_its_input_before_it_ever_drove_ends_it_with_its_last_words(tmp_path: Path) -> None:
    robot = DeadChild("robot", "none", (), tmp_path / "robot.log")
    robot.start = lambda: (tmp_path / "robot.log").write_text("/drive: nobody listens there")  # type: ignore[method-assign, assignment, return-value]
    turns = iter([False] * 5 + [True] * 50)
    supervisor = Supervisor([], robot, Deaf(), lambda: next(turns), lambda: None)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="nobody listens there"):
        supervisor.run()


def test_several_robots_have_names_and_scenes_of_their_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    plan = planned(monkeypatch, tmp_path, "--robots", "3", "--name", "r7", "--seed", "4")
    assert plan.names == ("r7", "r8", "r9")
    robots = [plan.robot_process(index) for index in range(3)]
    told = [dict(zip(robot.arguments[::2], robot.arguments[1::2], strict=False)) for robot in robots]
    assert [(options["--name"], options["--seed"]) for options in told] == [("r7", "4"), ("r8", "5"), ("r9", "6")]
    assert len({options["--summary"] for options in told}) == len({robot.log for robot in robots}) == 3
    assert planned(monkeypatch, tmp_path, "--name", "ann").names == ("ann",)
    assert planned(monkeypatch, tmp_path, "--name", "ann", "--robots", "2").names == ("ann1", "ann2")


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--robots", "0"], "--robots: got 0, wanted 1 to 8"),
        (["--robots", "9"], "--robots: got 9, wanted 1 to 8"),
        (["--robots", "2", "--secure"], "--robots: got more than 1 with --secure"),
    ],
)
def test_robots_that_cannot_be_are_refused(tmp_path: Path, options: list[str], complaint: str) -> None:
    result = CliRunner().invoke(up.command, [*options, "--out", str(tmp_path)])
    assert complaint in str(result.exception)


def test_an_address_is_told_once_somebody_answers_there(free_port: int) -> None:
    page = _Page(f"http://127.0.0.1:{free_port}/live?token=t")
    assert page.lines() == []
    with socket.create_server(("127.0.0.1", free_port)):
        until = time.monotonic() + 30.0
        while not page.lines() and time.monotonic() < until:
            time.sleep(0.05)
        assert page.lines() == [f"workbench http://127.0.0.1:{free_port}/live?token=t"]
    assert page.lines(), "a page that ended is the supervisor's affair, not news of an address"
    assert _Page("").lines() == []


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.processes
def test_two_robots_drive_side_by_side(tmp_path: Path) -> None:
    options = ("--robots", "2", "--headless", "--lockstep", "--seconds", "4", "--json", "--out", str(tmp_path))
    command = [sys.executable, "-m", "safedpa_services", "up", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["ticks"] == summary["robots"]["r2"]["ticks"] == 80
    assert sum(summary["verdicts"].values()) == 80, "those of the first robot alone"
