"""The experiment of several cars on one field: it repeats, and counts who touches and blocks whom."""

import json
from collections.abc import Callable
from dataclasses import asdict
from itertools import combinations
from math import cos, hypot, pi, sin
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa_lab.experiments.common.statistics import clopper_pearson_interval
from safedpa_lab.experiments.sensing import meeting
from safedpa_lab.experiments.sensing.meeting import (
    Meeting,
    meeting_experiment,
    meeting_field,
    meeting_scenes,
    page_of,
    pieces_of,
    run_meeting,
    stuck_pairs,
)
from safedpa_services.command_line.group import safedpa
from safedpa_sim.robots.car.contacts import Collision
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.car.shared_field import CarContact


@pytest.mark.long
@pytest.mark.parametrize("guard", ["safedpa", "reported", "nothing"])
def test_a_meeting_repeats_bit_for_bit(guard: str) -> None:
    once, again = (run_meeting(Meeting(4690, 2, 1.5, 2.0, guard)) for _ in "12")
    assert once == again
    assert once["fastest_driven"] > 0.3
    assert len(once["goals"]) == 2


@pytest.mark.parametrize(("robots", "load"), [(2, "none"), (8, "none"), (4, "large_chair")])
def test_all_begin_apart_on_the_field_of_the_seed_and_have_goals_of_their_own(robots: int, load: str) -> None:
    scenes = meeting_scenes(4691, robots, load)
    assert (scenes, len(scenes)) == (meeting_scenes(4691, robots, load), robots)
    assert (scenes[0], len({one.obstacles for one in scenes})) == (Scene.random(4691, load), 1)
    for one, other in combinations(scenes, 2):
        assert hypot(one.start[0] - other.start[0], one.start[1] - other.start[1]) > 1.5
    assert len({next(one.goals()) for one in scenes}) == robots
    meeting_field(4691, robots, load).advance()


@pytest.mark.parametrize("robots", [1, 9])
def test_another_number_of_cars_is_refused(robots: int) -> None:
    with pytest.raises(InputError, match=f"robots: got {robots}, wanted 2 to 8"):
        meeting_scenes(4691, robots)


def test_the_discs_of_another_car_cover_all_of_it() -> None:
    robot = meeting_field(4692, 2, "chair").robots[1]
    pieces = pieces_of(robot)
    for _, shape in robot.world.bodies:
        for corner in map(shape.body.local_to_world, shape.get_vertices()):  # type: ignore[union-attr]
            assert (
                min(hypot(corner.x - one.position[0], corner.y - one.position[1]) - one.radius for one in pieces) < 1e-9
            )


@pytest.mark.parametrize(
    ("yaws", "face"),
    [
        ((0.0, pi), True),
        ((0.0, 0.0), False),  # one behind the other
        ((pi, pi), False),
        ((pi, 0.0), False),  # back to back
        ((0.4 * pi, 0.6 * pi), True),  # nearly side by side, each still in the other's front half
        ((0.4 * pi, 0.4 * pi), False),
        ((-0.4 * pi, 0.7 * pi), True),
        ((-0.6 * pi, pi), False),
    ],
)
@pytest.mark.parametrize("turn", [0.0, 0.5 * pi, -2.0])
@pytest.mark.parametrize("periods", [1, 200])
def test_two_stuck_cars_face_each_other_if_each_is_in_front_of_the_other(yaws, face, turn, periods) -> None:
    """One metre apart, however the field is turned; of a short drive all of it counts."""
    path = np.zeros((periods, 2, 4))
    path[:, 1, :2] = cos(turn), sin(turn)
    path[:, :, 2] = np.array(yaws) + turn
    assert stuck_pairs(path) == [{"robots": [0, 1], "face": face}]


@pytest.mark.parametrize(
    ("apart", "moved_at", "by", "stuck"),
    [
        (1.4, 0, 0.0, True), (1.6, 0, 0.0, False),
        (1.0, 39, 0.5, True), (1.0, 40, 0.5, False),  # of 200 periods the last 8 s are 160
        (1.0, 150, 0.15, True), (1.0, 150, 0.25, False),
    ],
)  # fmt: skip
def test_two_cars_are_stuck_if_they_stood_near_each_other_for_the_last_eight_seconds(apart, moved_at, by, stuck):
    """The second one was elsewhere in a single period; a third is always far away, a fourth creeps past all."""
    path = np.zeros((200, 4, 4))
    path[:, 1, 0], path[:, 2, 1], path[:, 3, 1] = apart, 9.0, np.linspace(0.0, 1.0, 200)
    path[moved_at, 1, 0] += by
    assert [pair["robots"] for pair in stuck_pairs(path)] == ([[0, 1]] if stuck else [])


def test_contacts_of_a_meeting_are_counted_by_who_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six contacts of two cars: one of them moved in three, both in one, neither in two; and four with walls."""
    speeds = [(0.5, 0.0), (0.0, 0.5), (0.02, 0.7), (0.5, 0.5), (0.0, 0.0), (0.02, 0.01)]
    touches = [CarContact(1.0 + k, (0, 1), ("car", "load"), pair) for k, pair in enumerate(speeds)]
    walls = [
        [Collision(1.0, "car", "a wall", 0.0, 0.0, speed, speed) for speed in own] for own in ((0.5, 0.0), (0.3, 0.4))
    ]
    field: Any = meeting_field(4690, 2, "none")
    own = SimpleNamespace(touches=touches, robots=field.robots, collisions=walls.__getitem__)
    moved = [[(0.0, 0.0, 0.0, 1.5), (9.0, 0.0, 0.0, 0.0)], [(0.1, 0.0, 0.0, -1.75), (9.0, 0.0, 0.0, 0.01)]]
    path = [[SimpleNamespace(state=SimpleNamespace(values=values)) for values in tick] for tick in moved]
    monkeypatch.setattr(meeting, "meeting_field", lambda *_: own)
    monkeypatch.setattr(meeting, "drive_together", lambda *_: iter(path))
    reported = run_meeting(Meeting(4690, 2, 0.1, 2.0))
    assert (len(reported["moving"]), reported["into_standing"], reported["both_standing"]) == (4, 3, 2)
    assert reported["moving"][0] == "car of robot 0 at 0.50 m/s against load of robot 1 at 0.00 m/s, t=1.00 s"
    assert (len(reported["solid"]), reported["fastest_driven"]) == (3, 1.75)
    assert (reported["standing_share"], reported["stuck"]) == (0.5, [])


def meetings(patch: pytest.MonkeyPatch, own: Callable[[Meeting], dict[str, Any]], *asked: Any, **options: Any):
    """The experiment with meetings that come to what is given."""
    usual: dict[str, Any] = {
        "moving": [], "into_standing": 0, "both_standing": 0, "solid": [], "standing_share": 0.25, "goals": [1, 2],
        "fastest_driven": 1.5, "stuck": [],
    }  # fmt: skip
    patch.setattr(meeting, "run_meeting", lambda wanted: {**asdict(wanted), **usual, **own(wanted)})
    return meeting_experiment(*asked, **{"processes": 1} | options)


def test_a_row_and_its_line_count_all_contacts_and_stuck_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three drives of two robots, a minute each."""
    own = {
        1: {
            "moving": ["r1 r2", "r2 r1"], "into_standing": 1, "both_standing": 2, "goals": [0, 0],
            "standing_share": 0.75,
        },
        2: {"solid": ["r1 wall"], "both_standing": 1, "stuck": [{"face": True}, {"face": False}]},
        3: {"moving": ["r1 r2"], "stuck": [{"face": True}], "goals": [4, 0], "fastest_driven": 1.9},
    }  # fmt: skip
    result = meetings(monkeypatch, lambda wanted: own[wanted.seed], [1, 2, 3], [2], 60.0, guards=("safedpa",))
    (row,) = result["rows"]
    assert row == {
        "robots": 2, "guard": "safedpa", "drives": 3, "drives_in_which_a_moving_car_touched_another": 2,
        "share_95": clopper_pearson_interval(2, 3), "contacts_in_which_a_car_moved": 3,
        "of_them_with_a_standing_car": 1, "contacts_of_standing_cars": 3, "moved_into_what_is_at_rest": 1,
        "which": [
            "seed 1, load none: r1 r2", "seed 1, load none: r2 r1", "seed 2, load none: r1 wall",
            "seed 3, load none: r1 r2",
        ],
        "goals_a_minute_and_robot": pytest.approx(7.0 / 6.0), "robots_without_a_goal": 3,
        "share_of_time_standing": pytest.approx(1.25 / 3.0), "stuck_pairs": 3, "stuck_face_to_face": 2,
        "fastest_driven": 1.9,
    }  # fmt: skip
    page = page_of(result)
    low, high = (100.0 * end for end in clopper_pearson_interval(2, 3))
    cells = f"3 | 2 | {low:.1f} to {high:.1f} % | 3, 1 | 3 | 1 | 1.2 | 3 of 6 | 0.42 | 3, 2"
    assert f"| 2 | this filter, laser alone | {cells} |" in page.split("\n")
    assert "- 2 cars, safedpa: seed 2, load none: r1 wall" in page


def test_meetings_have_a_row_for_each_number_of_cars_and_guard(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two and three cars behind two guards, with two seeds and two loads; each kind has other goals."""
    goals = {(2, "safedpa"): 1, (2, "nothing"): 2, (3, "safedpa"): 3, (3, "nothing"): 4}
    reported: list[tuple[int, int]] = []
    found = meetings(
        monkeypatch, lambda one: {"goals": [goals[one.robots, one.guard]] * one.robots}, [5, 6], [2, 3], 60.0,
        guards=("safedpa", "nothing"), loads=("none", "box"), on_drive=lambda *one: reported.append(one),
    )  # fmt: skip
    assert reported == [(number, 16) for number in range(1, 17)]
    assert {(row["robots"], row["guard"]): row["drives"] for row in found["rows"]} == dict.fromkeys(goals, 4)
    assert [row["goals_a_minute_and_robot"] for row in found["rows"]] == [1.0, 2.0, 3.0, 4.0]
    assert len({(one["seed"], one["load"], one["robots"], one["guard"]) for one in found["drives"]}) == 16


def test_by_command_with_a_page(tmp_path: Path) -> None:
    out, page = tmp_path / "meeting.json", tmp_path / "meeting.md"
    phrase = ["experiment", "meeting", "--robots", "2", "--seeds", "1", "--first-seed", "4694", "--seconds", "0.5"]
    assert safedpa.run([*phrase, "--guard", "nothing", "--processes", "1", "--out", str(out), "--page", str(page)]) == 0
    result = json.loads(out.read_text(encoding="utf-8"))
    assert [row["robots"] for row in result["rows"]] == [2]
    assert "--first-seed 4694" in page.read_text(encoding="utf-8")
