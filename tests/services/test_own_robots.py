"""Robots of one's own, each a folder outside the package: checked, driven by nodes and processes, diagnosed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.check_robot import check_robot
from safedpa.dynamics import load_model, load_own
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.robot import robot_named, robots
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.shipped import settings_named
from safedpa_services.command_line.group import safedpa
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.stand_in_robot import StandInRobot

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
WORLDS = {"drone": {"wind": 1.5}, "differential_drive": {"pull": 0.5, "lag": 0.06}}
FILES = {name: EXAMPLES / name / f"{name}.py" for name in WORLDS}


@pytest.fixture(scope="module", params=sorted(WORLDS))
def name(request: pytest.FixtureRequest) -> str:
    """Of a robot that is known from here on."""
    load_own(FILES[request.param])
    return str(request.param)


def test_nothing_is_wrong_with_it(name: str) -> None:
    found = check_robot(robot_named(name))
    assert [str(one) for one in found if not one.ends_well] == []
    assert {"system", "model", "settings", "barriers", "filter", "controllers", "draw"} <= {one.part for one in found}


def test_it_reaches_goals_and_touches_nothing_in_a_world_that_no_model_knows(name: str) -> None:
    robot, model = robot_named(name), load_model(str(robot_named(name).model))
    simulated = StandInRobot(robot, 1.0 / robot.rate, 1, WORLDS[name])
    nodes = [AdaptationNode(model), PolicyNode(model), SafetyFilterNode(model, settings_named(name))]
    statuses = {tick.verdict.status for tick in drive(simulated, nodes, round(15 * robot.rate))}
    assert simulated.collisions == []
    assert simulated.goals_reached >= 2
    assert statuses <= {"passed", "corrected"}


def test_settings_of_another_robot_are_refused(name: str) -> None:
    model = load_model(str(robot_named(name).model))
    for other in set(robots()) - {name}:
        with pytest.raises(InputError, match="settings: made for the system"):
            SafetyFilterNode(model, settings_named(other))


@pytest.mark.processes
def test_up_drives_it_and_its_recording_tells_what_is_hidden(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file, out = FILES[name], tmp_path / "runs"
    world = [word for key, value in WORLDS[name].items() for word in ("--world", f"{key}={value}")]
    words = ["up", "--robot-file", str(file), "--lockstep", "--headless", "--seconds", "12", "--json"]
    assert safedpa.run([*words, *world, "--seed", "1", "--out", str(out)]) == 0
    summary = json.loads(capfd.readouterr().out)
    assert summary["collisions"] == 0, summary
    (recording,) = out.glob("*/recording.mcap")
    page = tmp_path / "page"
    plain = str(file.with_name("plain.toml"))
    words = ["diagnose", plain, str(recording), "--robot-file", str(file), "--json", "--out", str(page)]
    assert safedpa.run(words) == 0
    told = capfd.readouterr().out
    assert {"drone": "ax_offset", "differential_drive": "pull"}[name] in told


def test_a_file_without_a_robot_and_one_that_lacks_something_cost_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty, half = tmp_path / "empty.py", tmp_path / "half.py"
    empty.write_text("from safedpa.effects import general_effects\n", encoding="utf-8")
    half.write_text("from safedpa.robot import AbstractRobot\nclass Half(AbstractRobot):\n    rate = 1.0\n", "utf-8")
    for file, said in ((empty, "wanted a class derived from"), (half, "class Half: 'bases' is missing")):
        assert safedpa.run(["check", str(file)]) == 2
        line = capsys.readouterr().err
        assert said in line
        assert line.count("\n") == 1


def test_what_its_own_code_raises_is_a_sentence_and_the_backup_acts(monkeypatch: pytest.MonkeyPatch) -> None:
    load_own(FILES["drone"])
    robot, model = robot_named("drone"), load_model(str(robot_named("drone").model))

    def broken(*_: object) -> None:
        raise ZeroDivisionError("a tree of no size")

    monkeypatch.setattr(type(robot), "barriers", broken)
    simulated = StandInRobot(robot, 0.04, 1)
    nodes = [AdaptationNode(model), PolicyNode(model), SafetyFilterNode(model, settings_named("drone"))]
    ticks = list(drive(simulated, nodes, 5))
    assert {tick.verdict.status for tick in ticks} == {"fallback"}
    assert "ZeroDivisionError" in ticks[-1].verdict.sentence
    assert np.hypot(*simulated.values[2:]) < 0.1
    (finding,) = [one for one in check_robot(robot) if not one.ends_well]
    assert "a tree of no size" in finding.sentence
