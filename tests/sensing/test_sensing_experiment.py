"""The experiment's drives repeat, and know a car that moves into something from one that is walked into."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from safedpa.bus import SURROUNDINGS, SurroundingsMessage
from safedpa.errors import InputError
from safedpa_lab.experiments.sensing import GUARDS, LOADS, POLICIES, Drive, run_drive, sensing_experiment
from safedpa_lab.experiments.sensing_page import page_of
from safedpa_lab.experiments.sensing_scenes import SCENES, scene_and_people
from safedpa_lab.experiments.sensing_told import TellsEverything
from safedpa_sim.robots.contacts import Collision
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.senses import Senses
from safedpa_sim.sensing.shapes import Outline, room_to


def test_a_drive_repeats_and_only_the_sensing_ones_see_people() -> None:
    once, again = (run_drive(Drive("people", 1000, 4.0, 1.5)) for _ in range(2))
    assert {**once, "microseconds": 0} == {**again, "microseconds": 0}


def test_with_perfect_knowledge_the_car_drives_farther() -> None:
    way = {guard: run_drive(Drive("pillars", 1001, 6.0, 1.5, guard))["way"] for guard in ("told", "safedpa")}
    assert way["told"] > way["safedpa"] > 0.0


@pytest.mark.long
def test_a_filter_that_assumes_slower_people_drives_faster() -> None:
    quick, slow = (run_drive(Drive("pillars", 1001, 8.0, coming))["way"] for coming in (0.0, 1.5))
    assert quick > slow


@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize("kind", SCENES)
def test_start_and_goals_of_a_scene_are_free_and_the_same_again(kind: str, load: str) -> None:
    scene, people = scene_and_people(kind, 1002, load)
    again, others = scene_and_people(kind, 1002, load)
    assert scene == again
    assert [one.place for one in people] == [one.place for one in others]
    solid = Outline(scene.obstacles, scene.polygons, (scene.field,))
    for x, y in (scene.start[:2], *scene.fixed_goals):
        assert room_to(solid, x, y) > scene.footprint[2]


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


def test_a_scene_that_does_not_exist_is_refused() -> None:
    with pytest.raises(InputError, match=r"scene 'room'.*rooms"):
        scene_and_people("room", 1, "none")


def test_perfect_knowledge_includes_every_wall_and_every_person() -> None:
    scene, people = scene_and_people("rooms", 1004, "none")
    robot = CarRobot(scene, senses=Senses((Laser(LaserSettings(), 1),), people))
    state = robot.state_message()
    told = TellsEverything(scene, people).step("r1", state, {})[SURROUNDINGS]
    assert isinstance(told, SurroundingsMessage)
    assert [one[:2] for one in told.movers] == [one.place for one in people]
    points = np.array(told.points)
    solid = Outline(scene.obstacles, scene.polygons, (scene.field,))
    x, y, _ = scene.start
    nearest = (np.hypot(points[:, 0] - x, points[:, 1] - y) - points[:, 2]).min()
    assert abs(nearest - room_to(solid, x, y)) < 0.02


@pytest.mark.long
def test_a_result_has_the_share_of_perfect_knowledge_and_its_page_shows_it() -> None:
    found = sensing_experiment([1003], 2.0, 1.5, 1, ("safedpa", "told"), scenes=["pillars"], loads=["none", "box"])
    alone, told = found["rows"]
    assert (alone["drives"], told["drives"]) == (2, 2)
    assert alone["share_95"][1] == pytest.approx(0.842, abs=0.001)
    goals = {"goals_a_minute": 30.0, "goals_beside_perfect_knowledge": [0.5, 0.4, 0.6], "which": ["seed 3: a wall"]}
    page = page_of({**found, "rows": [{**alone, **goals}, told]})
    assert "| 30.0 | 0.50 (0.40 to 0.60) |" in page
    assert "loads none, box, 2 s each" in page
    assert "- pillars, safedpa: seed 3: a wall" in page


def test_people_who_walk_into_a_stationary_car_are_counted_separately(monkeypatch: pytest.MonkeyPatch) -> None:
    """By hand: of five contacts two with a car that moves, one of them away from what it touches."""
    speeds = ((0.0, 0.0), (1.0, 1.0), (0.0, 0.0), (2.0, -0.5), (0.0, 0.0))
    hits = [Collision(0.1, "car", "obstacle 0", 0.0, 0.0, *speed) for speed in speeds]
    monkeypatch.setattr(CarRobot, "collisions", property(lambda _: hits))
    told = run_drive(Drive("pillars", 1000, 0.1, 1.5))
    assert told["standing"] == 3
    assert told["moving"] == [str(hits[1]), str(hits[3])]
    assert told["run_into"] == 1


@pytest.mark.long
def test_knowing_all_but_hidden_people_the_car_drives_no_farther_than_knowing_all() -> None:
    way = {guard: run_drive(Drive("pillars", 1001, 6.0, 1.5, guard))["way"] for guard in ("told", "told-but-hiding")}
    assert way["told"] > way["told-but-hiding"] > 0.0


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
        told = run_drive(Drive("steps-out", seed, 6.0, 1.5, load=load, policy="way_seeker"))
        assert told["moving"] == []
        assert told["way"] > 1.0


def test_what_a_record_holds_is_not_driven_again(tmp_path: Path) -> None:
    path, wanted = tmp_path / "drives.jsonl", {"seeds": [1003], "seconds": 1.0, "coming": 1.5, "processes": 1}
    some = {"guards": ("told",), "scenes": ["pillars"], "loads": ["none"]}
    first = sensing_experiment(**wanted, **some, record=path)
    lines = path.read_text(encoding="utf-8").splitlines()
    assert len(lines) == 2
    told = json.loads(lines[1])
    path.write_text("\n".join([lines[0], json.dumps({**told, "goals": 1000}), '{"scene": "pil']), encoding="utf-8")
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
        sensing_experiment([1003], 1.0, 1.5, 1, ("told",), scenes=["pillars"], record=path)
    assert path.read_text(encoding="utf-8") == holds
