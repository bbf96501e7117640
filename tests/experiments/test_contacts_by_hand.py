"""Who touches whom in a drive, and how often, from robots that have touched what is written down by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import cos, pi, sin
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import load_model
from safedpa_lab.experiments import (
    live_drive,
    long_drives,
    margin_drives,
    meeting,
    reversing_drives,
    sensing,
    wheels,
)
from safedpa_lab.experiments.adversary import drives as hostile
from safedpa_lab.experiments.meeting_scenes import meeting_field
from safedpa_sim.robots.contacts import Collision
from safedpa_sim.robots.shared_field import Touch
from safedpa_sim.sensing import StepsOut
from safedpa_sim.sensing.people import Person
from safedpa_sim.sensing.shapes import Outline, Point

STORY = [("passed", 0.5), ("corrected", 0.25), ("passed", -0.125), ("fallback", 0.75)]
NODES = ("AdaptationNode", "PolicyNode", "SafetyFilterNode", "margin_for", "ReversingNode")
Touched = tuple[int, int, dict[str, int]]
"""Contacts, goals, and how many of each status."""


def ticks() -> Iterator[Any]:
    """Four periods, backwards at 1 m/s."""
    for number, (status, h) in enumerate(STORY):
        state = SimpleNamespace(robot_time=0.05 * number, values=(0.1 * number, 0.0, 0.0, -1.0), tick=number)
        yield SimpleNamespace(verdict=SimpleNamespace(status=status, h_now=h, microseconds=100.0), state=state)


def put_in(module: Any, robot: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of the nodes and of the drive."""
    for name in (*NODES, "StandInRobot", "CarRobot", "_car", "settings_named"):
        if hasattr(module, name):
            monkeypatch.setattr(module, name, lambda *_, **__: robot)
    if hasattr(module, "load_model"):
        monkeypatch.setattr(module, "load_model", lambda _: SimpleNamespace(period=0.05))
    monkeypatch.setattr(module, "drive", lambda *_, **__: ticks(), raising=False)


def on_wheels(robot: Any, monkeypatch: pytest.MonkeyPatch) -> Touched:
    put_in(wheels, robot, monkeypatch)
    monkeypatch.setattr(wheels.dataclasses, "replace", lambda *_, **__: None)
    found = wheels.run_drive(wheels.WheelsDrive(next(iter(wheels.WORLDS)), 1, "straight", True, 0.2))
    assert (found["least_h"], found["microseconds"]) == (-0.125, 100.0)
    assert found["way"] == pytest.approx(0.2)
    return found["collisions"], found["goals"], found["statuses"]


def for_long(robot: Any, monkeypatch: pytest.MonkeyPatch) -> Touched:
    put_in(long_drives, robot, monkeypatch)
    monkeypatch.setattr(long_drives, "note_standstill", lambda *_: None)
    found = long_drives.run_long_drive(long_drives.LongDrive("none", 1, 0.2))
    return found.collisions, found.goals, found.statuses


def against_a_hostile_wish(robot: Any, _: pytest.MonkeyPatch) -> Touched:
    found = hostile._driven("car", "none", 1, robot, ticks())
    assert found.least_h == -0.125
    return found.collisions, robot.goals_reached, found.statuses


def backwards(robot: Any, monkeypatch: pytest.MonkeyPatch) -> Touched:
    put_in(reversing_drives, robot, monkeypatch)
    found = reversing_drives.run_reversing_drive(reversing_drives.ReversingDrive("none", 1, 0.2))
    assert found.least_h == -0.125
    return found.collisions, robot.goals_reached, found.statuses


def for_a_margin(robot: Any, monkeypatch: pytest.MonkeyPatch) -> Touched:
    put_in(margin_drives, robot, monkeypatch)
    monkeypatch.setattr(margin_drives, "replace", lambda *_, **__: None)
    monkeypatch.setattr(margin_drives, "drive_heights", lambda _model, _settings, along: {"steps": len(along)})
    driver = margin_drives.Driver("car", "car", lambda _: robot, 20.0)
    monkeypatch.setattr(margin_drives, "DRIVERS", {"car": driver})
    found = margin_drives.driven(margin_drives.DriveOrder("car", 9, None))
    assert (found.seed, found.ticks, found.heights, found.least_h) == (9, 4, {"steps": 4}, -0.125)
    return found.collisions, found.goals, found.statuses


@pytest.mark.parametrize(
    "driven", [on_wheels, for_long, against_a_hostile_wish, backwards, for_a_margin], ids=lambda one: one.__name__
)
@pytest.mark.parametrize("touched", [0, 1, 3])
def test_every_contact_of_a_drive_is_counted(
    driven: Callable[[Any, pytest.MonkeyPatch], Touched], touched: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = SimpleNamespace(collisions=["a wall"] * touched, goals_reached=5, values=(0.0, 0.0, 0.0, 0.0))
    assert driven(robot, monkeypatch) == (touched, 5, {"passed": 2, "corrected": 1, "fallback": 1})


@pytest.mark.parametrize("touched", [0, 1, 3])
def test_every_contact_of_a_drive_that_is_diagnosed_is_counted(touched: int, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = SimpleNamespace(collisions=["a wall"] * touched, goals_reached=5, changed_at=40, tick=60)
    put_in(live_drive, robot, monkeypatch)
    monkeypatch.setattr(live_drive, "_nodes", lambda _: (None, []))
    found = live_drive.drive_live("nothing", 1, 0.2)
    assert (found.collisions, found.goals, found.least_h) == (touched, 5, -0.125)
    assert (found.changed, found.driven) == (pytest.approx(2.0), pytest.approx(3.0))


class Stands(Person):
    def velocity(self, time: float, robot: Point, outline: Outline) -> Point:
        del time, robot, outline
        return 0.0, 0.0


def hit(speed: float, towards: float) -> Collision:
    return Collision(time=1.0, part="car", what="a person", x=0.0, y=0.0, speed=speed, towards=towards)


def among_people(hits: list[Collision], people: list[Person], monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    robot = SimpleNamespace(collisions=hits, goals_reached=0, trajectory_hash="t")
    monkeypatch.setattr(sensing, "CarRobot", lambda *_, **__: robot)
    monkeypatch.setattr(sensing, "scene_and_people", lambda *_: (None, people))
    monkeypatch.setattr(sensing, "_nodes", lambda *_: [])
    verdict = SimpleNamespace(wish=(), action=(0.0, 0.0), microseconds=1.0)
    state = SimpleNamespace(values=(0.0, 0.0, 0.0, 0.0))
    monkeypatch.setattr(sensing, "drive", lambda *_: iter([SimpleNamespace(verdict=verdict, state=state)]))
    return sensing.run_drive(sensing.Drive("pillars", 1000, 0.05, 1.5))


@pytest.mark.parametrize(
    ("hits", "run_into"),
    [
        ([(0.5, 0.5)], 0),
        ([(0.5, 0.0)], 1),
        ([(0.5, 0.0), (0.5, 0.5), (0.4, -0.4), (0.9, 0.01)], 3),  # from aside, from behind, and nearly from aside
        ([(0.0, 0.0), (0.01, 0.0)], 0),  # while it stood: they are counted elsewhere
        ([], 0),
    ],
)
def test_of_contacts_while_the_car_moved_those_are_told_that_it_did_not_drive_towards(
    hits: list[tuple[float, float]], run_into: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert among_people([hit(*one) for one in hits], [], monkeypatch)["run_into"] == run_into


@pytest.mark.parametrize(
    ("stepped", "told"), [([True], True), ([False], False), ([False, True, False], True), ([None], False), ([], False),
                          ([None, True], True), ([None, False], False)],
)  # fmt: skip
def test_somebody_stepped_out_where_any_of_those_who_may_has(
    stepped: list[bool | None], told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """None: somebody who stands there from the beginning."""
    people: list[Person] = []
    for one in stepped:
        people.append(Stands((0.0, 0.0)) if one is None else StepsOut((0.0, 0.0), (1.0, 0.0), 1.0, 2.0))
        if one is not None:
            people[-1].stepped = one  # type: ignore[attr-defined]
    assert among_people([], people, monkeypatch)["stepped_out"] is told


@pytest.mark.parametrize(
    ("wishes", "kept"),
    [
        ([(1.0, 0.5), (-1.0, -0.5)], 0.5),
        ([(-2.0, -2.0), (2.0, 0.0)], 0.5),
        ([(1.0, -1.0), (-1.0, 1.0)], 0.0),  # the other way
        ([(-0.5, -2.0), (0.5, 2.0)], 1.0),  # faster than it was wished counts as all of it
        ([(0.0, 1.0), (-1.0, -0.25)], 0.25),
        ([(0.0, 0.0)], 0.0),
    ],
)
def test_of_wishes_to_drive_either_way_a_share_is_kept(
    wishes: list[tuple[float, float]], kept: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wished and driven, m/s; in as many periods of 50 ms as the seconds have."""
    robot = SimpleNamespace(collisions=[], goals_reached=0, trajectory_hash="t")
    monkeypatch.setattr(sensing, "CarRobot", lambda *_, **__: robot)
    monkeypatch.setattr(sensing, "scene_and_people", lambda *_: (None, []))
    monkeypatch.setattr(sensing, "_nodes", lambda *_: [])

    def driven(_robot: Any, _nodes: Any, periods: int) -> Iterator[Any]:
        assert periods == len(wishes)
        for wish, action in wishes:
            verdict = SimpleNamespace(wish=(wish, 0.0), action=(action, 0.0), microseconds=1.0)
            yield SimpleNamespace(verdict=verdict, state=SimpleNamespace(values=(0.0, 0.0, 0.0, 0.0)))

    monkeypatch.setattr(sensing, "drive", driven)
    told = sensing.run_drive(sensing.Drive("pillars", 1000, 0.05 * len(wishes), 1.5))
    assert told["kept"] == pytest.approx(kept)


def test_drives_are_told_by_scene_and_guard_beside_those_that_are_told_everything() -> None:
    """Four kinds with two drives each; of 6, 2, 5 and 1 goals each."""
    kinds = [(scene, guard) for scene in ("pillars", "people") for guard in ("told", "nothing")]
    usual: dict[str, Any] = {
        "load": "none", "moving": [], "run_into": 0, "standing": 0, "stepped_out": False, "way": 1.0, "kept": 1.0,
        "microseconds": 1.0,
    }  # fmt: skip
    drives = [
        {"scene": scene, "guard": guard, "seed": seed, "goals": goals, **usual}
        for (scene, guard), goals in zip(kinds, (6, 2, 5, 1), strict=True)
        for seed in (1, 2)
    ]
    told = sensing._result([1, 2], 60.0, 1.5, kinds, ["none"], "goal_seeker", drives)
    assert [(row["scene"], row["guard"], row["drives"]) for row in told["rows"]] == [(*kind, 2) for kind in kinds]
    assert [row["goals_a_minute"] for row in told["rows"]] == [6.0, 2.0, 5.0, 1.0]
    beside = [row["goals_beside_perfect_knowledge"][0] for row in told["rows"]]
    assert beside == pytest.approx([1.0, 1.0 / 3.0, 1.0, 0.2])
    assert [row["goals_a_minute"] for row in told["by_load"]] == [6.0, 2.0, 5.0, 1.0]


@pytest.mark.parametrize(
    ("guard", "names"),
    [
        ("safedpa", ["AdaptationNode", "PerceptionNode", "PolicyNode", "SafetyFilterNode"]),
        ("told", ["AdaptationNode", "TellsEverything", "PolicyNode", "SafetyFilterNode"]),
        ("nothing", ["AdaptationNode", "PerceptionNode", "PolicyNode", "NoFilter"]),
    ],
)
def test_who_stands_between_the_policy_and_the_cars_of_a_meeting(guard: str, names: list[str]) -> None:
    wanted = meeting.Meeting(4690, 2, 0.1, 2.0, guard)
    model, field = load_model("car"), meeting_field(4690, 2, "none")
    for index in range(2):
        assert [type(node).__name__ for node in meeting._nodes(wanted, model, field, index)] == names


@pytest.mark.parametrize(
    ("guard", "policy", "names"),
    [
        ("safedpa", "goal_seeker", ["AdaptationNode", "PerceptionNode", "PolicyNode", "SafetyFilterNode"]),
        ("told", "goal_seeker", ["AdaptationNode", "TellsEverything", "PolicyNode", "SafetyFilterNode"]),
        ("told-but-hiding", "way_seeker", ["AdaptationNode", "TellsAllButWhoHides", "PolicyNode", "SafetyFilterNode"]),
        ("monitor", "goal_seeker", ["AdaptationNode", "PolicyNode", "CollisionMonitor"]),
        ("monitor-2s", "way_seeker", ["AdaptationNode", "PerceptionNode", "PolicyNode", "CollisionMonitor"]),
        ("time-to-collision", "goal_seeker", ["AdaptationNode", "PolicyNode", "TimeToCollision"]),
        ("nothing", "way_seeker", ["AdaptationNode", "PerceptionNode", "PolicyNode", "NoFilter"]),
    ],
)
def test_who_stands_between_the_policy_and_a_car_with_a_laser(guard: str, policy: str, names: list[str]) -> None:
    """Behind everybody a controller that looks around has the same perception; one that looks nowhere needs none."""
    scene, people = sensing.scene_and_people("pillars", 1000, "none", 1.5)
    wanted = sensing.Drive("pillars", 1000, 0.1, 1.5, guard, policy=policy)
    assert [type(node).__name__ for node in sensing._nodes(wanted, load_model("car"), scene, people)] == names


def test_contacts_of_a_meeting_are_told_by_who_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six contacts of two cars: one of them moved in three, both in one, neither in two; and three with walls."""
    speeds = [(0.5, 0.0), (0.0, 0.5), (0.02, 0.7), (0.5, 0.5), (0.0, 0.0), (0.02, 0.01)]
    touches = [Touch(1.0 + k, (0, 1), ("car", "car"), pair) for k, pair in enumerate(speeds)]
    walls = [[hit(0.5, 0.5), hit(0.0, 0.0)], [hit(0.3, 0.3), hit(0.4, 0.4)]]
    robots = [SimpleNamespace(goals_reached=goals, trajectory_hash=str(goals)) for goals in (2, 3)]
    field = SimpleNamespace(touches=touches, robots=robots, collisions=walls.__getitem__)
    moved = [[(0.0, 0.0, 0.0, 1.5), (9.0, 0.0, 0.0, 0.0)], [(0.1, 0.0, 0.0, -1.75), (9.0, 0.0, 0.0, 0.01)]]
    path = [[SimpleNamespace(state=SimpleNamespace(values=values)) for values in tick] for tick in moved]
    monkeypatch.setattr(meeting, "load_model", lambda _: None)
    monkeypatch.setattr(meeting, "meeting_field", lambda *_: field)
    monkeypatch.setattr(meeting, "_nodes", lambda *_: [])
    monkeypatch.setattr(meeting, "drive_together", lambda *_: iter(path))
    told = meeting.run_meeting(meeting.Meeting(4690, 2, 0.1, 2.0))
    assert (len(told["moving"]), told["into_standing"], told["both_standing"]) == (4, 3, 2)
    assert (len(told["solid"]), told["goals"], told["fastest_driven"]) == (3, [2, 3], 1.75)
    assert (told["standing_share"], told["stuck"]) == (0.5, [])


def test_contacts_of_several_meetings_are_added_up() -> None:
    usual: dict[str, Any] = {
        "seed": 1, "load": "none", "moving": ["a", "b"], "solid": ["w"], "into_standing": 2, "both_standing": 3,
        "goals": [0, 0], "standing_share": 0.5, "stuck": [{"face": True}] * 2, "fastest_driven": 1.0,
    }  # fmt: skip
    row = meeting._row(2, "told", [usual, usual, usual], 60.0)
    assert row["contacts_in_which_a_car_moved"] == 6
    assert (row["of_them_with_a_standing_car"], row["contacts_of_standing_cars"]) == (6, 9)
    assert (row["moved_into_what_is_at_rest"], row["stuck_pairs"], row["stuck_face_to_face"]) == (3, 6, 6)
    assert row["robots_without_a_goal"] == 6


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
def test_two_that_are_stuck_face_each_other_where_each_is_in_front_of_the_other(
    yaws: tuple[float, float], face: bool, turn: float
) -> None:
    """One metre apart, whichever way the field is turned."""
    path = np.zeros((200, 2, 4))
    path[:, 1, :2] = cos(turn), sin(turn)
    path[:, :, 2] = np.array(yaws) + turn
    assert meeting.stuck_pairs(path) == [{"robots": [0, 1], "face": face}]


@pytest.mark.parametrize(
    ("apart", "moved_at", "by", "stuck"),
    [
        (1.4, 0, 0.0, True), (1.6, 0, 0.0, False),
        (1.0, 39, 0.5, True), (1.0, 40, 0.5, False),  # of 200 periods the last 8 s are 160
        (1.0, 150, 0.15, True), (1.0, 150, 0.25, False),
    ],
)  # fmt: skip
def test_two_are_stuck_where_they_stood_near_each_other_for_the_last_eight_seconds(
    apart: float, moved_at: int, by: float, stuck: bool
) -> None:
    """The second one was elsewhere in a single period; a third is always far away."""
    path = np.zeros((200, 3, 4))
    path[:, 1, 0], path[:, 2, 1] = apart, 9.0
    path[moved_at, 1, 0] += by
    assert [pair["robots"] for pair in meeting.stuck_pairs(path)] == ([[0, 1]] if stuck else [])


@pytest.mark.parametrize("periods", [1, 3])
def test_of_a_short_drive_all_of_it_is_looked_at(periods: int) -> None:
    path = np.zeros((periods, 2, 4))
    path[:, 1, 0] = 1.0
    path[0, 1, 0] += 0.0 if periods == 1 else 0.5
    assert len(meeting.stuck_pairs(path)) == (periods == 1)


def test_meetings_are_told_by_how_many_met_and_behind_whom(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two and three cars behind two guards, with two seeds and two loads; each kind has other goals."""
    goals = {(2, "safedpa"): 1, (2, "nothing"): 2, (3, "safedpa"): 3, (3, "nothing"): 4}

    class Pool:
        def __init__(self, *_: Any, **__: Any) -> None: ...

        def __enter__(self) -> Any:
            return SimpleNamespace(map=map)

        def __exit__(self, *_: object) -> None: ...

    def run(wanted: meeting.Meeting) -> dict[str, Any]:
        own = goals[wanted.robots, wanted.guard]
        return {
            **vars(wanted), "moving": [], "into_standing": 0, "both_standing": 0, "solid": [], "standing_share": 0.5,
            "goals": [own] * wanted.robots, "fastest_driven": 1.0, "stuck": [],
        }  # fmt: skip

    monkeypatch.setattr(meeting, "ProcessPoolExecutor", Pool)
    monkeypatch.setattr(meeting, "run_meeting", run)
    told: list[tuple[int, int]] = []
    found = meeting.meeting_experiment(
        [5, 6], [2, 3], 60.0, guards=("safedpa", "nothing"), loads=("none", "box"),
        on_drive=lambda *one: told.append(one),
    )  # fmt: skip
    assert told == [(number, 16) for number in range(1, 17)]
    assert {(row["robots"], row["guard"]): row["drives"] for row in found["rows"]} == dict.fromkeys(goals, 4)
    assert [row["goals_a_minute_and_robot"] for row in found["rows"]] == [1.0, 2.0, 3.0, 4.0]
    assert len({(one["seed"], one["load"], one["robots"], one["guard"]) for one in found["drives"]}) == 16
