"""The experiment of a laser among people: its drives repeat, its curves show every value, its margins cover."""

import json
from dataclasses import replace
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from safedpa.adaptation import AdaptationNode
from safedpa.bus import SURROUNDINGS, ReceivedMessage, SurroundingsMessage
from safedpa.bus.messages.messages import ActionMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.perception import PerceptionNode, PerceptionSettings
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_lab.commands.experiment import EXPERIMENTS, ExperimentCommand
from safedpa_lab.experiments.sensing import experiment as sensing
from safedpa_lab.experiments.sensing import margins as sensing_margins
from safedpa_lab.experiments.sensing.curves import CURVES, curves_experiment, curves_page, draw_curves
from safedpa_lab.experiments.sensing.experiment import (
    GUARDS,
    LOADS,
    POLICIES,
    Drive,
    page_of,
    run_drive,
    sensing_experiment,
)
from safedpa_lab.experiments.sensing.margins import SensedDrive, margins_of_sensing, order
from safedpa_lab.experiments.sensing.nodes import ReportsEverything
from safedpa_lab.experiments.sensing.scenes import SCENES, scene_and_people
from safedpa_lab.experiments.sensing.scores import NEAR, Misjudges, Score, Scores, WaysAround
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.contacts import Collision
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors
from safedpa_sim.sensing.shapes import Outline, box, clearance_at

COMMAND = ExperimentCommand(EXPERIMENTS["sensing-margins"])


def test_a_drive_repeats_people_are_seen_by_sensing_alone_and_perfect_knowledge_drives_farther() -> None:
    once, again = (run_drive(Drive("people", 1000, 4.0, 1.5)) for _ in range(2))
    assert {**once, "microseconds": 0} == {**again, "microseconds": 0}
    way = {guard: run_drive(Drive("pillars", 1001, 6.0, 1.5, guard))["way"] for guard in ("reported", "safedpa")}
    assert way["reported"] > way["safedpa"] > 0.0


@pytest.mark.long
def test_a_filter_that_assumes_slower_people_drives_faster() -> None:
    quick, slow = (run_drive(Drive("pillars", 1001, 8.0, coming))["way"] for coming in (0.0, 1.5))
    assert quick > slow


@pytest.mark.long
@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize("kind", SCENES)
def test_start_and_goals_of_a_scene_are_free_and_the_same_again(kind: str, load: str) -> None:
    scene, people = scene_and_people(kind, 1002, load)
    again, others = scene_and_people(kind, 1002, load)
    assert scene == again
    assert [one.position for one in people] == [one.position for one in others]
    solid = Outline(scene.obstacles, scene.polygons, (scene.field,))
    for x, y in (scene.start[:2], *scene.fixed_goals):
        assert clearance_at(solid, x, y) > scene.footprint[2]


@pytest.mark.long
def test_a_room_has_a_door_that_the_car_fits_through() -> None:
    for seed in range(1000, 1010):
        scene, people = scene_and_people("rooms", seed, "large_chair")
        low, high = scene.polygons[:2]
        door = min(y for _, y in high) - max(y for _, y in low)
        assert door >= 2.0 * scene.footprint[2] + 0.9
        assert len(people) <= 6
        sides = {x > low[0][0] for x, _ in scene.fixed_goals}
        assert sides == {True, False}


def test_scenes_that_do_not_exist_are_refused_and_so_are_their_margins() -> None:
    with pytest.raises(InputError, match=r"scene 'room'.*rooms"):
        scene_and_people("room", 1, "none")
    refused = CliRunner().invoke(COMMAND, ["--scene", "room"])
    assert isinstance(refused.exception, InputError)


def test_perfect_knowledge_includes_every_wall_and_every_person() -> None:
    scene, people = scene_and_people("rooms", 1004, "none")
    robot = CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(LaserSettings(), 1),), people))
    state = robot.state_message()
    reported = ReportsEverything(scene, people).step("r1", state, {})[SURROUNDINGS]
    assert isinstance(reported, SurroundingsMessage)
    assert [one[:2] for one in reported.movers] == [one.position for one in people]
    points = np.array(reported.points)
    solid = Outline(scene.obstacles, scene.polygons, (scene.field,))
    x, y, _ = scene.start
    nearest = (np.hypot(points[:, 0] - x, points[:, 1] - y) - points[:, 2]).min()
    assert abs(nearest - clearance_at(solid, x, y)) < 0.02


@pytest.mark.long
def test_a_result_has_the_share_of_perfect_knowledge_and_its_page_shows_it() -> None:
    found = sensing_experiment([1003], 2.0, 1.5, 1, ("safedpa", "reported"), scenes=["pillars"], loads=["none", "box"])
    alone, reported = found["rows"]
    assert (alone["drives"], reported["drives"]) == (2, 2)
    assert alone["share_95"][1] == pytest.approx(0.842, abs=0.001)
    goals = {"goals_a_minute": 30.0, "goals_beside_perfect_knowledge": [0.5, 0.4, 0.6], "which": ["seed 3: a wall"]}
    page = page_of({**found, "rows": [{**alone, **goals}, reported]})
    assert "| 30.0 | 0.50 (0.40 to 0.60) |" in page
    assert "loads none, box, 2 s each" in page
    assert "- pillars, safedpa: seed 3: a wall" in page


def test_people_who_walk_into_a_stationary_car_are_counted_separately(monkeypatch: pytest.MonkeyPatch) -> None:
    """By hand: of five contacts two with a car that moves, one of them away from what it touches."""
    speeds = ((0.0, 0.0), (1.0, 1.0), (0.0, 0.0), (2.0, -0.5), (0.0, 0.0))
    hits = [Collision(0.1, "car", "obstacle 0", 0.0, 0.0, *speed) for speed in speeds]
    monkeypatch.setattr(CarRobot, "collisions", property(lambda _: hits))
    reported = run_drive(Drive("pillars", 1000, 0.1, 1.5))
    assert reported["standing"] == 3
    assert reported["moving"] == [str(hits[1]), str(hits[3])]
    assert reported["run_into"] == 1


@pytest.mark.long
def test_knowing_all_but_hidden_people_the_car_drives_no_farther_than_knowing_all() -> None:
    way = {
        guard: run_drive(Drive("pillars", 1001, 6.0, 1.5, guard))["way"]
        for guard in ("reported", "reported-but-hiding")
    }
    assert way["reported"] > way["reported-but-hiding"] > 0.0


@pytest.mark.long
@pytest.mark.parametrize("guard", GUARDS)
@pytest.mark.parametrize("policy", POLICIES)
def test_behind_each_guard_either_controller_drives(guard: str, policy: str) -> None:
    assert run_drive(Drive("pillars", 1001, 2.0, 1.5, guard, policy=policy))["way"] > 0.1


@pytest.mark.long
@pytest.mark.parametrize("load", ["none", "large_chair"])
def test_a_person_who_steps_out_meets_no_moving_car(load: str) -> None:
    """Behind the controller that looks around, which creeps past unseen room."""
    for seed in (3810, 3811):
        reported = run_drive(Drive("steps-out", seed, 6.0, 1.5, load=load, policy="way_seeker"))
        assert reported["moving"] == []
        assert reported["way"] > 1.0


def test_what_a_record_holds_is_not_driven_again(tmp_path: Path) -> None:
    path, wanted = tmp_path / "drives.jsonl", {"seeds": [1003], "seconds": 1.0, "coming": 1.5, "processes": 1}
    some = {"guards": ("reported",), "scenes": ["pillars"], "loads": ["none"]}
    first = sensing_experiment(**wanted, **some, record=path)
    lines = path.read_text(encoding="utf-8").splitlines()
    assert len(lines) == 2
    reported = json.loads(lines[1])
    path.write_text("\n".join([lines[0], json.dumps({**reported, "goals": 1000}), '{"scene": "pil']), encoding="utf-8")
    again = sensing_experiment(**wanted, **{**some, "loads": ["none", "box"]}, record=path)
    assert again["rows"][0]["drives"] == 2
    assert again["by_load"][0]["goals_a_minute"] == 60_000.0, "taken from the record"
    assert first["by_load"][0]["goals_a_minute"] < 60_000.0
    assert len(path.read_text(encoding="utf-8").splitlines()) == 3


@pytest.mark.parametrize("holds", ["", "1", '{"code": {}}', '{"code": {"a": 1}}\n{"scene": "pillars"}'])
def test_another_file_or_other_code_is_no_record(holds: str, tmp_path: Path) -> None:
    path = tmp_path / "drives.jsonl"
    path.write_text(holds, encoding="utf-8")
    with pytest.raises(InputError, match=r"drives\.jsonl: .*wanted"):
        sensing_experiment([1003], 1.0, 1.5, 1, ("reported",), scenes=["pillars"], record=path)
    assert path.read_text(encoding="utf-8") == holds


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    curves = {"walking": (0.0, 1.5), "field_of_view": (pi / 2, 2.0 * pi)}
    return curves_experiment([1003, 1004], 2.0, 1, curves=curves)


@pytest.mark.long
def test_a_row_is_of_the_drives_with_its_value(result: dict[str, Any]) -> None:
    rows = {(row["curve"], row["value"]): row for row in result["rows"]}
    assert list(rows) == [("walking", 0.0), ("walking", 1.5), ("field_of_view", pi / 2), ("field_of_view", 2.0 * pi)]
    for (curve, value), row in rows.items():
        drives = [Drive("people", seed, 2.0, 1.5, policy="way_seeker", **{curve: value}) for seed in (1003, 1004)]
        way = sum(run_drive(drive)["way"] for drive in drives)
        assert row["metres_a_minute"] == pytest.approx(60.0 * way / 4.0)
        assert row["drives"] == 2
    plain = [row for row in result["rows"] if row["value"] in (1.5, 2.0 * pi)]
    reported = [
        run_drive(Drive("people", seed, 2.0, 1.5, "reported", policy="way_seeker"))["goals"] for seed in (1003, 1004)
    ]
    assert plain[0]["goals_a_minute_told_everything"] == pytest.approx(60.0 * sum(reported) / 4.0)
    assert {**plain[0], "curve": "", "value": 0, "median_microseconds": 0} == {
        **plain[1], "curve": "", "value": 0, "median_microseconds": 0
    }, "the values that are as elsewhere are the same drives"  # fmt: skip


def test_what_curves_share_is_driven_once_and_the_progress_comes_to_its_end() -> None:
    reported: list[tuple[int, int]] = []
    curves = {"walking": (0.0, 1.5), "noise": (0.02,)}
    curves_experiment([1003], 0.5, 1, lambda done, of: reported.append((done, of)), curves=curves)
    assert reported == [(done, 4) for done in (1, 2, 3, 4)], "two with the laser, and two with perfect knowledge"


def test_what_a_curve_changes_reaches_the_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[LaserSettings] = []
    whole = sensing.make_sources
    monkeypatch.setattr(sensing, "make_sources", lambda *given: made.append(given[2]) or whole(*given))
    usual = Drive("people", 1003, 0.1, 1.5)
    for name in ("noise", "latency", "field_of_view"):
        run_drive(replace(usual, **{name: 0.25}))
        assert made[-1] == replace(LaserSettings(), **{name: 0.25})
    fast = np.array([one.speed for one in moved(3.0)])
    assert (fast <= 3.0).all()
    assert fast.max() > 1.5
    assert max(one.speed for one in moved(0.0)) == 0.0


def moved(walking: float) -> list[Any]:
    """People of a scene after three seconds near a stationary robot, with the greatest speed that each had."""
    scene, people = scene_and_people("people", 1005, "none", walking)
    outline = Outline(scene.obstacles, scene.polygons, (scene.field,))
    for one in people:
        one.speed = max(float(np.hypot(*one.velocity(0.05 * tick, (50.0, 50.0), outline))) for tick in range(60))
    return list(people)


def test_the_usual_value_is_part_of_each_curve() -> None:
    usual = Drive("people", 0, 1.0, 1.5)
    assert all(getattr(usual, name) in values for name, values in CURVES.items())


@pytest.mark.long
@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in CURVES.items() for value in values])
def test_every_value_of_every_curve_can_be_driven(name: str, value: float) -> None:
    changed: dict[str, Any] = {name: value}
    assert run_drive(replace(Drive("people", 1003, 0.1, 1.5, policy="way_seeker"), **changed))["moving"] == []


@pytest.mark.long
def test_page_and_picture(result: dict[str, Any], tmp_path: Path) -> None:
    page = curves_page(result)
    assert "| 90 | 2 |" in page
    assert "| 1.5 | 2 |" in page
    assert "noise of a range" not in page
    draw_curves(result, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 10_000


SMALLER = 0.04
"""m"""


def car_in(scene: Scene, people: Any = ()) -> CarRobot:
    return CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(LaserSettings(), 1),), people))


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
    assert right.reported_pose == pytest.approx(right.true_pose)
    assert right.true_pose == wrong.true_pose
    assert wrong.reported_pose[2] - begun[2] == pytest.approx(1.2 * (right.true_pose[2] - begun[2]))
    way = np.hypot(right.reported_pose[0] - begun[0], right.reported_pose[1] - begun[1])
    assert np.hypot(wrong.reported_pose[0] - begun[0], wrong.reported_pose[1] - begun[1]) == pytest.approx(
        1.1 * way, rel=0.01
    )
    assert wrong.state_message().values[3] == pytest.approx(1.1 * right.state_message().values[3])
    ahead = np.array(
        [[right.true_pose[0] + np.cos(right.true_pose[2]), right.true_pose[1] + np.sin(right.true_pose[2])]]
    )
    x, y, yaw = wrong.reported_pose
    assert wrong.in_reported_frame(ahead)[0] == pytest.approx([x + np.cos(yaw), y + np.sin(yaw)])


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

    def hear(self, item: ReceivedMessage) -> None:
        reported = item.message
        if isinstance(reported, SurroundingsMessage):
            movers, hidden = (
                tuple((*row[:2], row[2] - SMALLER, *row[3:]) for row in rows)
                for rows in (reported.movers, reported.hidden)
            )
            item = item._replace(message=replace(reported, movers=movers, hidden=hidden))
        self.scores.hear(item)


@pytest.mark.long
def test_an_object_that_is_reported_too_far_away_is_an_error_of_that_distance() -> None:
    scene, people = scene_and_people("steps-out", 1000, "large_chair")
    robot, model, settings = Misjudges(car_in(scene, people), 0.01, -0.01), load_model("car"), settings_named("car")
    nodes = [AdaptationNode(model), PerceptionNode(), PolicyNode(model, "way_seeker")]
    sensing = PerceptionSettings()
    right, smaller = (Scores(robot, people, settings, sensing) for _ in range(2))
    farther = _Farther(smaller)

    def hear(item: ReceivedMessage) -> None:
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
    done = CliRunner().invoke(COMMAND, [*asked, "--out", str(out), "--page", str(page)])
    assert done.exit_code == 0, done.output
    result = json.loads(done.output)
    assert {row["kind"] for row in result["rows"]} == {"obstacle", "mover", "hidden", "model", "stood"}
    assert "| the model alone |" in page.read_text(encoding="utf-8")
    assert json.loads(out.read_text(encoding="utf-8"))["rows"] == result["rows"]
    lines = (tmp_path / "drives.jsonl").read_text(encoding="utf-8")
    assert json.loads(CliRunner().invoke(COMMAND, asked).output) == result
    assert (tmp_path / "drives.jsonl").read_text(encoding="utf-8") == lines


@pytest.mark.parametrize("holds", ["", "1\n", '{"code": {}}\n'])
def test_another_file_is_no_record(holds: str, tmp_path: Path) -> None:
    path = tmp_path / "drives.jsonl"
    path.write_text(holds, encoding="utf-8")
    with pytest.raises(InputError, match=r"drives\.jsonl: .*wanted"):
        margins_of_sensing(2, 1, 0.1, 0.6, record=path)


@pytest.mark.parametrize(("drives", "coverage", "notice"), [(98, 0.99, "at least 99"), (2, 1.0, "coverage")])
def test_too_few_drives_are_refused_before_they_are_driven(drives, coverage, notice, monkeypatch):
    monkeypatch.setattr(sensing_margins, "driven", lambda *_: pytest.fail("driven"))
    with pytest.raises(InputError, match=notice):
        margins_of_sensing(drives, 1, 8.0, coverage)


def test_drives_in_which_nothing_comes_near_and_what_is_no_record_are_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="near anything"):
        margins_of_sensing(2, 1, 0.05, 0.6)
    (tmp_path / "picture").write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path, tmp_path / "picture"):
        with pytest.raises(InputError, match="cannot be kept as a record"):
            margins_of_sensing(2, 1, 0.1, 0.6, record=path)
