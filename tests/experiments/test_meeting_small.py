"""The experiment of several cars on one field: it repeats, and what it counts is counted by hand."""

from __future__ import annotations

import json
from itertools import combinations
from math import hypot, pi
from pathlib import Path

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa_lab.experiments.meeting import Meeting, _row, meeting_experiment, run_meeting, stuck_pairs
from safedpa_lab.experiments.meeting_page import page_of
from safedpa_lab.experiments.meeting_scenes import meeting_field, meeting_scenes, pieces_of
from safedpa_services.command_line.group import safedpa
from safedpa_sim.robots.scene import Scene
from safedpa_sim.robots.shared_field import SharedField, Touch


@pytest.mark.long
@pytest.mark.parametrize("guard", ["safedpa", "told", "nothing"])
def test_a_meeting_repeats_bit_for_bit(guard: str) -> None:
    once, again = (run_meeting(Meeting(4690, 2, 1.5, 2.0, guard)) for _ in "12")
    assert once == again
    assert once["fastest_driven"] > 0.3
    assert len(once["goals"]) == 2


@pytest.mark.parametrize(("robots", "load"), [(2, "none"), (8, "none"), (4, "large_chair")])
def test_all_begin_apart_on_the_field_of_the_seed_and_have_goals_of_their_own(robots: int, load: str) -> None:
    scenes = meeting_scenes(4691, robots, load)
    assert scenes == meeting_scenes(4691, robots, load)
    assert len(scenes) == robots
    assert scenes[0] == Scene.random(4691, load)
    assert len({one.obstacles for one in scenes}) == 1
    for one, other in combinations(scenes, 2):
        assert hypot(one.start[0] - other.start[0], one.start[1] - other.start[1]) > 1.5
    assert len({next(one.goals()) for one in scenes}) == robots
    meeting_field(4691, robots, load).advance()


@pytest.mark.parametrize("robots", [1, 9])
def test_another_number_of_cars_is_refused(robots: int) -> None:
    with pytest.raises(InputError, match=f"robots: got {robots}, wanted 2 to 8"):
        meeting_scenes(4691, robots)


def test_what_a_car_is_told_of_another_holds_all_of_it() -> None:
    robot = meeting_field(4692, 2, "chair").robots[1]
    pieces = pieces_of(robot)
    for _, shape in robot.world.bodies:
        for corner in map(shape.body.local_to_world, shape.get_vertices()):  # type: ignore[union-attr]
            assert min(hypot(corner.x - one.place[0], corner.y - one.place[1]) - one.radius for one in pieces) < 1e-9


def test_who_is_stuck_by_hand() -> None:
    """Of five cars 0 and 1 stand face to face, 2 stands behind 1, 3 is far away, and 4 creeps past all."""
    path = np.zeros((400, 5, 4))
    path[:, 0], path[:, 1], path[:, 2] = (0.0, 0.0, 0.0, 0.0), (1.0, 0.0, pi, 0.0), (2.2, 0.0, pi, 0.0)
    path[:, 3] = (0.0, 3.0, 0.0, 0.0)
    path[:, 4, 0] = np.linspace(0.0, 1.0, 400)
    path[:240, 0, 0] = -1.0
    assert stuck_pairs(path) == [{"robots": [0, 1], "face": True}, {"robots": [1, 2], "face": False}]
    path[:241, 0, 0] = -1.0
    assert stuck_pairs(path) == [{"robots": [1, 2], "face": False}]


def test_a_contact_counts_as_moving_where_either_car_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    speeds = [(0.5, 0.0), (0.0, 0.5), (0.5, 0.5), (0.05, 0.0), (0.1, 0.05)]
    touches = [Touch(1.0 + k, (0, 1), ("car", "load"), pair) for k, pair in enumerate(speeds)]
    told = run_of_touches(monkeypatch, touches)
    assert len(told["moving"]) == 4
    assert told["into_standing"] == 3
    assert told["both_standing"] == 1
    assert told["moving"][0] == "car of robot 0 at 0.50 m/s against load of robot 1 at 0.00 m/s, t=1.00 s"


def run_of_touches(monkeypatch: pytest.MonkeyPatch, touches: list[Touch]) -> dict[str, list[str]]:
    def advance(self: SharedField) -> None:
        self.touches = touches

    monkeypatch.setattr(SharedField, "advance", advance)
    return run_meeting(Meeting(4693, 2, 0.05, 2.0, "nothing"))


def test_a_row_and_its_line_by_hand() -> None:
    still = {"moving": [], "into_standing": 0, "both_standing": 2, "solid": [], "goals": [3, 0], "stuck": []}
    usual = {"seed": 4, "load": "none", "standing_share": 0.25, "fastest_driven": 1.5}
    hits = {"moving": ["this", "that"], "into_standing": 1, "solid": ["a wall"], "standing_share": 0.75}
    stuck = {"stuck": [{"robots": [0, 1], "face": True}, {"robots": [0, 1], "face": False}], "goals": [0, 0]}
    row = _row(2, "safedpa", [usual | still, usual | still | hits | stuck], 30.0)
    assert row["drives_in_which_a_moving_car_touched_another"] == 1
    assert row["contacts_in_which_a_car_moved"] == 2
    assert row["goals_a_minute_and_robot"] == 1.5
    assert row["which"] == [f"seed 4, load none: {what}" for what in ("this", "that", "a wall")]
    result = {"seeds": [4, 5], "loads": ["none"], "seconds": 30.0, "fastest": 2.0, "rows": [row]}
    page = page_of(result)
    line = "| 2 | this filter, laser alone | 2 | 1 | 1.3 to 98.7 % | 2, 1 | 4 | 1 | 1.5 | 3 of 4 | 0.50 | 2, 1 |"
    assert line in page.split("\n")
    assert "- 2 cars, safedpa: seed 4, load none: a wall" in page


def test_by_command_with_a_page(tmp_path: Path) -> None:
    out, page = tmp_path / "meeting.json", tmp_path / "meeting.md"
    words = ["experiment", "meeting", "--robots", "2", "--seeds", "1", "--first-seed", "4694", "--seconds", "0.5"]
    assert safedpa.run([*words, "--guard", "nothing", "--processes", "1", "--out", str(out), "--page", str(page)]) == 0
    result = json.loads(out.read_text(encoding="utf-8"))
    assert [row["robots"] for row in result["rows"]] == [2]
    assert "--first-seed 4694" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--robots", "9"], "--robots: got 9, wanted 2 to 8"),
        (["--seconds", "0"], "--seconds: got 0.0"),
        (["--guard", "safe"], "did you mean"),
        (["--load", "sofa"], "--load sofa"),
        (["--fastest", "0"], "--fastest: got 0.0"),
        (["--out", "/nowhere/at/all.json"], "create it"),
    ],
)
def test_options_that_cannot_be_are_refused(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["experiment", "meeting", *words]) == 2
    assert said.lower() in capsys.readouterr().err.lower()


@pytest.mark.long
def test_every_guard_of_an_experiment_has_a_row() -> None:
    found = meeting_experiment([4695], [2], 0.5, guards=("safedpa", "told"), processes=1)
    assert [(row["robots"], row["guard"], row["drives"]) for row in found["rows"]] == [
        (2, "safedpa", 1),
        (2, "told", 1),
    ]
    assert len(found["drives"]) == 2
