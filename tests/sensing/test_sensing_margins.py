"""Margins of a laser: the scores mean what they say, and the calibration is that of all other margins."""

from __future__ import annotations

import json
from dataclasses import replace
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from safedpa.adaptation import AdaptationNode
from safedpa.bus import Received, SurroundingsMessage
from safedpa.bus.wire.messages import ActionMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.perception import PerceptionNode, PerceptionSettings
from safedpa.policy import PolicyNode
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.shipped import margin_for, settings_named
from safedpa_lab.commands.experiments.sensing_margins import command
from safedpa_lab.experiments import sensing_margins
from safedpa_lab.experiments.misjudging import Misjudges
from safedpa_lab.experiments.sensing_margins import SensedDrive, margins_of_sensing, order
from safedpa_lab.experiments.sensing_scenes import scene_and_people
from safedpa_lab.experiments.sensing_scores import NEAR, Score, Scores
from safedpa_lab.experiments.ways_around import WaysAround
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.senses import Senses
from safedpa_sim.sensing.shapes import box

SMALLER = 0.04
"""m"""


def car_in(scene: Scene, people: Any = ()) -> CarRobot:
    return CarRobot(scene, senses=Senses((Laser(LaserSettings(), 1),), people))


def test_wrong_odometry_reports_longer_paths_and_turns_and_leaves_the_scans_alone() -> None:
    scene = Scene(1, None, (-4.0, 4.0, -4.0, 4.0), (), (-3.0, 0.0, 0.3), ((3.0, 0.0),))
    right, wrong = Misjudges(car_in(scene), 0.0, 0.0), Misjudges(car_in(scene), 0.1, 0.2)
    begun = right.true_pose
    for tick in range(20):
        for robot in (right, wrong):
            message = robot.state_message()
            action = ActionMessage(
                epoch=1, tick=tick, robot_time=message.robot_time, publish_time=0.0, values=(1.0, 0.2)
            )
            assert robot.receive(action) is None
            robot.advance()
    assert right.told_pose == pytest.approx(right.true_pose)
    assert right.true_pose == wrong.true_pose
    assert wrong.told_pose[2] - begun[2] == pytest.approx(1.2 * (right.true_pose[2] - begun[2]))
    way = np.hypot(right.told_pose[0] - begun[0], right.told_pose[1] - begun[1])
    assert np.hypot(wrong.told_pose[0] - begun[0], wrong.told_pose[1] - begun[1]) == pytest.approx(1.1 * way, rel=0.01)
    assert wrong.state_message().values[3] == pytest.approx(1.1 * right.state_message().values[3])
    ahead = np.array(
        [[right.true_pose[0] + np.cos(right.true_pose[2]), right.true_pose[1] + np.sin(right.true_pose[2])]]
    )
    x, y, yaw = wrong.told_pose
    assert wrong.in_told_frame(ahead)[0] == pytest.approx([x + np.cos(yaw), y + np.sin(yaw)])


def test_a_path_around_a_wall_is_reported_no_longer_than_it_is() -> None:
    scene = Scene(1, None, (-3.0, 3.0, -3.0, 3.0), (), (0.0, 0.0, 0.0), ((1.0, 0.0),), (box(0.0, 0.0, 0.1, 2.0),))
    ways = WaysAround(scene, 0.2)

    def to(x: float, y: float, longest: float = 9.0) -> float:
        wanted = np.hypot(ways.places[:, 0] - x, ways.places[:, 1] - y) < 0.04
        return ways.to((-0.5, 0.0), wanted, longest)

    shortest = 2.0 * float(np.hypot(0.45, 1.0)) + 0.1  # around the wall's end alone, without his own width
    detour = 2.0 * float(np.hypot(0.25, 1.2)) + pi * 0.2 + 0.5
    assert shortest < to(0.5, 0.0) < detour
    assert 0.85 < to(-0.5, -1.0) <= 1.0
    assert to(0.5, 0.0, 1.5) == 1.5


class _Farther:
    """Scores of the same drive in which every disc that may move is reported smaller."""

    def __init__(self, scores: Scores) -> None:
        self.scores = scores

    def hear(self, item: Received) -> None:
        told = item.message
        if isinstance(told, SurroundingsMessage):
            movers, hidden = (
                tuple((*row[:2], row[2] - SMALLER, *row[3:]) for row in rows) for rows in (told.movers, told.hidden)
            )
            item = item._replace(message=replace(told, movers=movers, hidden=hidden))
        self.scores.hear(item)


@pytest.mark.long
def test_an_object_that_is_reported_too_far_away_is_an_error_of_that_distance() -> None:
    scene, people = scene_and_people("steps-out", 1000, "large_chair")
    robot, model, settings = Misjudges(car_in(scene, people), 0.01, -0.01), load_model("car"), settings_named("car")
    nodes = [AdaptationNode(model), PerceptionNode(), PolicyNode(model, "way_seeker")]
    sensing = PerceptionSettings()
    right, smaller = (Scores(robot, people, settings, sensing) for _ in range(2))
    farther = _Farther(smaller)

    def hear(item: Received) -> None:
        right.hear(item)
        farther.hear(item)

    for tick in drive(robot, [*nodes, SafetyFilterNode(model, settings, margin_for(model))], 120, hear=hear):
        right.after(tick)
        smaller.after(tick)
    one, other = ([score for score in scores.found if score.kind == "mover"] for scores in (right, smaller))
    assert len(one) == len(other) > 5
    apart = np.array([b.hoped - a.hoped for a, b in zip(one, other, strict=True)])
    assert (apart > -1e-9).all()
    assert (apart < SMALLER + 1e-9).all()
    assert np.median(apart) == pytest.approx(SMALLER)
    assert [score.true for score in one] == [score.true for score in other]
    assert all(abs(score.speed) >= 0.1 and score.seen_for > 0.0 for score in one)
    assert max(min(score.hoped, NEAR[score.kind]) - score.true for score in one) < 0.1, "the margin that ships"


def test_margins_are_those_of_the_drives_and_fresh_drives_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """By hand: 19 drives whose worst errors are 0.01 to 0.19 m, then two of which one has an error above that."""

    def made(wanted: SensedDrive) -> dict[str, Any]:
        worst = 0.01 * (wanted.seed - 1_000_000 + 1) if wanted.seed < 2_000_000 else 0.2 * (wanted.seed - 2_000_000)
        score = Score("mover", 1.0, worst + 0.1, 0.1, 1.0, 0, 1.0, (9.0, -0.1, 9.0), 0.08)
        less = score._replace(hoped=0.1)
        return {**vars(wanted), "moving": [], "goals": 1, "scores": [list(score), list(less)]}

    monkeypatch.setattr(sensing_margins, "run_sensed", made)
    found = margins_of_sensing(19, 2, 1.0, 0.95)
    (row,) = (each for each in found["rows"] if each["steps"])
    assert row["drive"] == pytest.approx(0.19)
    assert row["fresh"]["drive"]["drives"] == 0.5
    assert row["fresh"]["drive"]["steps"] == 0.75
    assert row["out"]["1"] == pytest.approx(-0.02)
    assert row["worst"][0]["error"] == pytest.approx(0.2)
    assert found["seeds"] == {"calibration": [1_000_000, 1_000_018], "evaluation": [2_000_000, 2_000_001]}
    assert len({(each.scene, each.load) for each in (order(index, index, 1.0) for index in range(12))}) == 12


@pytest.mark.long
def test_the_command_in_small_writes_a_page_and_drives_nothing_twice(tmp_path: Path) -> None:
    asked = ["--drives", "2", "--fresh", "1", "--seconds", "0.6", "--coverage", "0.6", "--processes", "1"]
    asked += ["--record", str(tmp_path / "drives.jsonl"), "--json"]
    page, out = tmp_path / "page.md", tmp_path / "result.json"
    done = CliRunner().invoke(command, [*asked, "--out", str(out), "--page", str(page)])
    assert done.exit_code == 0, done.output
    result = json.loads(done.output)
    assert {row["kind"] for row in result["rows"]} == {"obstacle", "mover", "hidden", "model", "stood"}
    assert "| the model alone |" in page.read_text(encoding="utf-8")
    assert json.loads(out.read_text(encoding="utf-8"))["rows"] == result["rows"]
    lines = (tmp_path / "drives.jsonl").read_text(encoding="utf-8")
    assert json.loads(CliRunner().invoke(command, asked).output) == result
    assert (tmp_path / "drives.jsonl").read_text(encoding="utf-8") == lines


@pytest.mark.parametrize("holds", ["", "1\n", '{"code": {}}\n'])
def test_another_file_is_no_record(holds: str, tmp_path: Path) -> None:
    path = tmp_path / "drives.jsonl"
    path.write_text(holds, encoding="utf-8")
    with pytest.raises(InputError, match=r"drives\.jsonl: .*wanted"):
        margins_of_sensing(2, 1, 0.1, 0.6, record=path)


@pytest.mark.parametrize(("drives", "coverage", "said"), [(98, 0.99, "at least 99"), (2, 1.0, "coverage")])
def test_too_few_drives_are_refused_before_they_are_driven(
    drives: int, coverage: float, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sensing_margins, "driven", lambda *_: pytest.fail("driven"))
    with pytest.raises(InputError, match=said):
        margins_of_sensing(drives, 1, 8.0, coverage)


def test_drives_in_which_nothing_comes_near_are_reported() -> None:
    with pytest.raises(InputError, match="near anything"):
        margins_of_sensing(2, 1, 0.05, 0.6)


def test_a_folder_and_what_is_no_text_are_no_record(tmp_path: Path) -> None:
    (tmp_path / "picture").write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path, tmp_path / "picture"):
        with pytest.raises(InputError, match="cannot be kept as a record"):
            margins_of_sensing(2, 1, 0.1, 0.6, record=path)


def test_a_scene_that_does_not_exist_is_refused() -> None:
    refused = CliRunner().invoke(command, ["--scene", "room"])
    assert isinstance(refused.exception, InputError)
