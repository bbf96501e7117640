"""What is counted in one drive, on drives that follow a script."""

import math
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.lab.experiments.drives import STATUSES, follow, robot, tick
from tests.messages import finding_of, stamp

from safedpa.adaptation import AdaptationNode
from safedpa.bus import FINDING, MODEL, ModelMessage, ReceivedMessage
from safedpa.dynamics import load_model
from safedpa.perception import PerceptionNode
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import MarginCalibration
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.adversary import drives as hostile
from safedpa_lab.experiments.car import episodes as car_episodes
from safedpa_lab.experiments.car import margin as car_margin
from safedpa_lab.experiments.car.conditions import Conditions
from safedpa_lab.experiments.car.drives import Drive, cut_at_contact
from safedpa_lab.experiments.car.methods import METHODS
from safedpa_lab.experiments.common import drives as common_drives
from safedpa_lab.experiments.diagnosis import live
from safedpa_lab.experiments.driving import controllers, delayed_drives, long_drives, reversing_drives, safety
from safedpa_lab.experiments.driving import differential_drive as wheels
from safedpa_lab.experiments.margins import drives as margin_drives
from safedpa_lab.experiments.sensing import experiment as sensing
from safedpa_lab.experiments.sensing.nodes import (
    CollisionMonitor,
    NoFilter,
    ReportsAllButWhoHides,
    ReportsEverything,
    TimeToCollision,
)
from safedpa_sim.robots import CarRobot, Scene
from safedpa_sim.robots.car.contacts import Collision
from safedpa_sim.sensing import StepsOut
from safedpa_sim.sensing.people import Person

Counted = tuple[int, Any, Any, float]
"""Contacts, goals, statuses and the least h; None where a drive does not report it."""
Patch = pytest.MonkeyPatch


def on_wheels(patch: Patch, own: Any) -> Counted:
    follow(patch, wheels, own, StandInRobot=own)
    found = wheels.run_drive(wheels.WheelsDrive(next(iter(wheels.WORLDS)), 1, "straight", True, 0.2))
    assert (found["way"], found["microseconds"]) == (pytest.approx(0.2), 100.0)
    return found["collisions"], found["goals"], found["statuses"], found["least_h"]


def backwards(patch: Patch, own: Any) -> Counted:
    follow(patch, reversing_drives, own)
    found, reversed_metres = reversing_drives.run_reversing_drive(reversing_drives.ReversingDrive("none", 1, 0.2))
    assert reversed_metres == pytest.approx(0.2)
    return found.collisions, None, found.statuses, found.least_h


def against_a_hostile_policy(patch: Patch, own: Any) -> Counted:
    follow(patch, hostile, own)
    found = hostile.KINDS["forward"]("none", 1, 0.2)
    return found.collisions, None, found.statuses, found.least_h


def for_a_margin(patch: Patch, own: Any) -> Counted:
    follow(patch, common_drives, own)
    patch.setattr(margin_drives, "barrier_residuals", lambda _model, _settings, along: {"steps": len(along)})
    patch.setattr(margin_drives, "DRIVERS", {"own": margin_drives.Driver("car", "car", lambda _: own, 0.2)})
    found = margin_drives.driven(margin_drives.DriveOrder("own", 9, None))
    assert (found.seed, found.ticks, found.heights) == (9, 4, {"steps": 4})
    return found.collisions, found.goals, found.statuses, found.least_h


def of_the_safety_table(patch: Patch, own: Any) -> Counted:
    follow(patch, safety, own)
    found = safety.run_episode(safety.Episode("box", 1, True, 0.2, "car", settings_named("car")))
    assert (found.changed, found.ticks) == (2, 4)
    return found.collisions, found.goals, found.statuses, found.least_h


def of_a_controller(patch: Patch, own: Any) -> Counted:
    follow(patch, controllers, own)
    found = controllers.timed_drive(load_model("car"), settings_named("car"), "goal_seeker", "none", 1, 0.2).outcome
    assert (found.ticks, found.changed) == (4, 2)
    return found.collisions, found.goals, None, -0.125


def with_a_diagnosis(patch: Patch, own: Any) -> Counted:
    follow(patch, live, own)
    own.changed_at, own.tick = 40, 60
    found = live.drive_live("nothing", 1, 0.2)
    assert (found.changed, found.driven) == (pytest.approx(2.0), pytest.approx(3.0))
    return found.collisions, found.goals, None, found.least_h


KINDS = [
    on_wheels, backwards, against_a_hostile_policy, for_a_margin, of_the_safety_table, of_a_controller,
    with_a_diagnosis,
]  # fmt: skip


@pytest.mark.parametrize("driven", KINDS, ids=lambda one: one.__name__)
@pytest.mark.parametrize("touched", [0, 1, 3])
def test_contacts_goals_statuses_and_the_least_h_of_a_drive_are_counted(driven, touched, monkeypatch) -> None:
    contacts, goals, statuses, least = driven(monkeypatch, robot(touched, goals=5))
    assert (contacts, least) == (touched, -0.125)
    assert goals in (None, 5)
    assert statuses in (None, STATUSES)


def long_drive(patch: Patch, start: Any, places: Sequence[Any], period: float) -> long_drives.LongOutcome:
    """Of a robot that starts somewhere and then is at these places, one in each period."""
    story = [tick(place=place, number=number, period=period) for number, place in enumerate(places)]
    own = robot(2, 5, values=(*start, 0.0, 0.0))
    follow(patch, long_drives, own, story)
    patch.setattr(long_drives, "load_model", lambda _: SimpleNamespace(period=period))
    for name in ("PolicyNode", "shipped_nodes"):
        patch.setattr(long_drives, name, lambda *_, **__: None)
    return long_drives.run_long_drive(long_drives.LongDrive("none", 1, period * len(places)))


@pytest.mark.parametrize(
    ("places", "longest"),
    [
        ([0.0, 0.1, 0.2, 0.3], 0.0),
        ([0.0, 0.0, 0.0, 0.0], 1.5),
        ([0.5, 1.0, 1.0, 1.015, 0.985, 1.0, 2.0, 2.0, 3.0], 2.0),  # from the second place on
        ([0.0, 0.01, 0.02, 0.03, 0.04, 0.05], 1.0),  # it creeps: more than 2 cm away it is another place
    ],
)
@pytest.mark.parametrize("way", [(1.0, 0.0), (0.0, -1.0), (-0.6, 0.8)])
def test_the_longest_stop_is_measured_within_two_centimetres(places, longest, way, monkeypatch) -> None:
    """In periods of half a second."""
    found = long_drive(monkeypatch, (9.0, 9.0), [(way[0] * place, way[1] * place) for place in places], 0.5)
    assert found.longest_stand == pytest.approx(longest)
    assert (found.collisions, found.goals, found.statuses) == (2, 5, {"passed": len(places)})


@pytest.mark.parametrize(
    ("steps", "least"),
    [
        ([1.0] * 20, 20.0),
        ([1.0] * 19, math.inf),  # shorter than 20 s
        ([1.0] * 30 + [0.0] * 5 + [1.0] * 30, 15.0),
        ([1.0] * 10 + [0.0] * 25 + [1.0] * 10, 0.0),
        ([0.5] * 10 + [1.0] * 15 + [-1.0] * 30, 15.0),  # there and back is a way as well
    ],
)
@pytest.mark.parametrize("period", [1.0, 0.5])
def test_the_least_way_is_that_of_the_twenty_seconds_with_the_least_progress(steps, least, period, monkeypatch) -> None:
    """Steps of a second each, m; reported every second, or twice as often."""
    often = round(1.0 / period)
    along = np.cumsum([0.0, *np.repeat(np.array(steps) / often, often)])
    places = [(0.6 * x, -0.8 * x) for x in along]
    found = long_drive(monkeypatch, places[0], places[1:], period)
    assert found.least_way == pytest.approx(least)


@pytest.mark.parametrize("goal_at", [None, 2])
@pytest.mark.parametrize("touched", [0, 2])
def test_an_episode_of_the_car_is_counted_to_its_goal(goal_at: int | None, touched: int, monkeypatch: Patch) -> None:
    statuses = ["passed", "corrected", "fallback", "disabled", "relaxed", "passed"]
    own = robot(touched, tick=6, goal=(0.0, 4.0))

    def driven(*_: Any) -> Iterator[Any]:
        for number, status in enumerate(statuses):
            own.goals_reached = int(goal_at is not None and number >= goal_at)
            yield tick(status, 0.1 * (5 - number))

    monkeypatch.setattr(car_episodes, "drive", driven)
    monkeypatch.setattr(car_episodes, "nodes_of", lambda *_: None)
    monkeypatch.setattr(Conditions, "nodes", lambda *_: None)
    monkeypatch.setattr(Conditions, "robot", lambda *_: own)
    (found,) = car_episodes.run_group(
        car_episodes.Cell(METHODS["rma"], "none", (4,), None, settings_named("car"), None)  # type: ignore[arg-type]
    )
    seen = statuses if goal_at is None else statuses[: goal_at + 1]
    assert (found.success, found.safe, found.collisions) == (goal_at is not None, not touched, touched)
    assert (found.changed, found.statuses) == (3 if goal_at is None else 2, {s: seen.count(s) for s in set(seen)})
    assert found.first_collision == ("a wall" if touched else "")
    assert found.least_h == pytest.approx(0.1 * (6 - len(seen)))


@pytest.mark.parametrize("errors", [[0.1, 0.5, 0.3], [0.5], [0.2, 0.2]])
def test_a_step_is_covered_if_its_error_is_at_most_the_margin(errors: list[float], monkeypatch: Patch) -> None:
    """Of the first state, and after a tick without a prediction, nothing was expected."""
    margin = MarginCalibration({"wall": 0.3}, 0.99, 99, "2026-01-01", "0123456789ab")
    count = car_margin.CoverageCount(settings_named("car"), margin)
    left = iter([*errors, 0.1])
    monkeypatch.setattr(car_margin, "worst_errors", lambda *_: {"wall": next(left)})
    state = CarRobot(Scene.random(1)).state_message()
    for _ in range(len(errors) + 1):
        count.see(state, ((0.0,) * 4,))
    assert count.counts == {"wall": [sum(error <= 0.3 for error in errors), len(errors)]}
    count.see(state, ())
    count.see(state, ((0.0,) * 4,))
    assert count.counts["wall"][1] == len(errors) + 1
    nothing = car_margin.CoverageCount(settings_named("car"), None)
    nothing.see(state, ((0.0,) * 4,))
    nothing.see(state, ((0.0,) * 4,))
    assert nothing.counts == {}


@pytest.mark.parametrize("collisions", [[0, 0, 2], [3, 0, 1], [0, 0, 0]])
def test_drives_under_a_delay_are_added_up(collisions: list[int], monkeypatch: Patch) -> None:
    robots = [robot(count, n + 1) for n, count in enumerate(collisions)]
    loads: list[str] = []

    def made(seed: int, load: str, heavier: float) -> Any:
        assert heavier == 1.0
        loads.append(load)
        return robots[seed - 10]

    def driven(own: Any, *_: Any, **__: Any) -> Iterator[Any]:
        for status in ("passed", "corrected", "passed"):
            yield tick(status, -0.1 * own.goals_reached)

    monkeypatch.setattr(delayed_drives, "drive", driven)
    lateness: Any = SimpleNamespace(model=load_model, robot=made, seconds=0.1)
    reported: list[tuple[int, int]] = []
    found = delayed_drives.delayed_drives(
        lateness, 3, 10, loads=("none", "box"), on_drive=lambda *done: reported.append(done)
    )
    assert (found.drives, found.collided, found.collisions) == (3, sum(map(bool, collisions)), sum(collisions))
    assert (found.goals, found.least_h, found.statuses) == (6, pytest.approx(-0.3), {"passed": 6, "corrected": 3})
    assert (loads, reported) == (["none", "box", "none"], [(1, 3), (2, 3), (3, 3)])


def hit(speed: float, towards: float) -> Collision:
    return Collision(time=1.0, part="car", what="a person", x=0.0, y=0.0, speed=speed, towards=towards)


def among_people(
    patch: Patch, own: Any = None, people: Sequence[Person] = (), story: Any = None, guard: str = "safedpa"
) -> Any:
    """A drive with a laser; and the nodes that it was driven with."""
    nodes: list[Any] = []
    story = story or [tick(speed=-0.8, nominal=(1.0, 0.0), action=(0.5, 0.0))] * 4

    def driven(_robot: Any, given: Any, periods: int) -> Iterator[Any]:
        assert periods == len(story)
        nodes.extend(given)
        yield from story

    patch.setattr(sensing, "drive", driven)
    patch.setattr(sensing, "CarRobot", lambda *_, **__: own or robot())
    if people:
        patch.setattr(sensing, "scene_and_people", lambda *_: (Scene.random(1), people))
    policy = sensing.POLICIES[1] if guard.islower() else sensing.POLICIES[0]
    wanted = sensing.Drive("pillars", 1000, 0.05 * len(story), 1.5, guard.lower(), policy=policy)
    return sensing.run_drive(wanted), [type(node) for node in nodes]


@pytest.mark.parametrize(
    ("hits", "moving", "run_into", "standing"),
    [
        ([], 0, 0, 0),
        ([(0.5, 0.5)], 1, 0, 0),
        ([(0.5, 0.0), (0.5, 0.5), (0.4, -0.4), (0.9, 0.01)], 4, 3, 0),  # from aside, behind, and nearly from aside
        ([(0.0, 0.0), (0.01, 0.0), (0.4, 0.4)], 1, 0, 2),  # while it was stationary
    ],
)
def test_contacts_are_counted_by_whether_the_car_moved_and_drove_towards_them(
    hits: list[tuple[float, float]], moving: int, run_into: int, standing: int, monkeypatch: Patch
) -> None:
    own = robot(goals=3)
    own.collisions = [hit(*one) for one in hits]
    reported, _ = among_people(monkeypatch, own)
    assert (len(reported["moving"]), reported["run_into"], reported["standing"]) == (moving, run_into, standing)
    assert (reported["goals"], reported["microseconds"]) == (3, 100.0)
    assert reported["way"] == pytest.approx(4 * 0.05 * 0.8)


@pytest.mark.parametrize(
    ("nominal_actions", "retained"),
    [
        ([(1.0, 0.5), (-1.0, -0.5)], 0.5),
        ([(-2.0, -2.0), (2.0, 0.0)], 0.5),
        ([(1.0, -1.0), (-1.0, 1.0)], 0.0),  # the other way
        ([(-0.5, -2.0), (0.5, 2.0)], 1.0),  # faster than the nominal speed counts as all of it
        ([(0.0, 1.0), (-1.0, -0.25)], 0.25),
        ([(0.0, 0.0)], 0.0),
    ],
)
def test_the_kept_share_of_nominal_speeds_counts_either_direction(nominal_actions, retained, monkeypatch) -> None:
    story = [tick(nominal=(nominal, 0.0), action=(action, 0.0)) for nominal, action in nominal_actions]
    assert among_people(monkeypatch, story=story)[0]["retained"] == pytest.approx(retained)


@pytest.mark.parametrize(
    ("stepped", "reported"),
    [([True], True), ([False], False), ([False, True, False], True), ([None], False), ([None, True], True)],
)
def test_a_drive_notes_whether_any_person_stepped_out(stepped, reported, monkeypatch) -> None:
    """None is a person who stands there from the beginning."""

    class IsStationary(Person):
        def velocity(self, *_: Any) -> tuple[float, float]:
            return 0.0, 0.0

    people: list[Any] = []
    for one in stepped:
        people.append(IsStationary((0.0, 0.0)) if one is None else StepsOut((0.0, 0.0), (1.0, 0.0), 1.0, 2.0))
        if one is not None:
            people[-1].stepped = one
    assert among_people(monkeypatch, people=people)[0]["stepped_out"] is reported


LOOKS = (AdaptationNode, PerceptionNode, PolicyNode)


@pytest.mark.parametrize(
    ("guard", "nodes"),
    [
        ("safedpa", (*LOOKS, SafetyFilterNode)),
        ("reported", (AdaptationNode, ReportsEverything, PolicyNode, SafetyFilterNode)),
        ("REPORTED-BUT-HIDING", (AdaptationNode, ReportsAllButWhoHides, PolicyNode, SafetyFilterNode)),
        ("monitor", (AdaptationNode, PolicyNode, CollisionMonitor)),
        ("MONITOR-2S", (*LOOKS, CollisionMonitor)),
        ("time-to-collision", (AdaptationNode, PolicyNode, TimeToCollision)),
        ("NOTHING", (*LOOKS, NoFilter)),
    ],
)
def test_a_controller_that_looks_around_has_the_same_perception_behind_each_guard(guard, nodes, monkeypatch) -> None:
    """In capitals: with the controller that looks around."""
    assert among_people(monkeypatch, guard=guard)[1] == list(nodes)


@pytest.mark.parametrize(("counts", "retained"), [((0, 0, 0), 3), ((0, 1, 1), 1), ((1, 1, 2), 0), ((0, 0, 1), 2)])
def test_a_drive_is_cut_at_its_first_contact(counts: tuple[int, ...], retained: int) -> None:
    messages: Any = tuple(SimpleNamespace(collisions=count) for count in counts)
    found = cut_at_contact(Drive(messages, ("a", "b", "c")))
    assert (len(found.messages), found.loads) == (retained, ("a", "b", "c")[:retained])


def at(speed: float = 0.0) -> Any:
    return SimpleNamespace(footprint=(0.1, 0.3, 0.2), values=(0.0, 0.0, 0.0, speed))


@pytest.mark.parametrize("within", [0, 1, 2, 3, 5, 6, 8])
def test_a_monitor_brakes_for_as_many_points_as_make_a_thing(within: int) -> None:
    """At 1 m/s the disc around the nose, 0.3 m ahead with 0.2 m, is at the points 1.04 m ahead within 0.6 s."""
    points = np.array([[1.04, 0.01 * n] for n in range(within)] + [[5.0, 0.0], [1.0, 2.0], [-3.0, 0.0]])
    for least in (1, 3, 6):
        share = CollisionMonitor(1.2, least).share_of(points, at(1.0), (1.0, 0.0))
        assert share == pytest.approx(0.5 if within >= least else 1.0, abs=0.01)


@pytest.mark.parametrize(
    ("apart", "share"), [(0.45, 0.0), (0.95, 5 / 12), (1.15, 7 / 12), (1.55, 11 / 12), (1.75, 1.0)]
)
def test_a_monitor_scales_the_nominal_action_by_the_time_left_over_its_patience(apart: float, share: float) -> None:
    """The nose is 0.5 m ahead, and steps are 0.1 s: 0.45 m beyond it are touched after 0.5 s."""
    points = np.full((6, 2), (apart, 0.0))
    assert CollisionMonitor(1.2).share_of(points, at(1.0), (1.0, 0.0)) == pytest.approx(share)


@pytest.mark.parametrize(
    ("points", "speed", "nominal", "share"),
    [
        ([[1.2, 0.0]], 1.0, 1.0, 0.0),  # 0.7 m beyond the nose
        ([[1.4, 0.0]], 1.0, 1.0, 1.0),  # 0.9 m
        ([[1.4, 0.0], [1.2, 0.1]], 1.0, 1.0, 0.0),
        ([[1.2, 0.3]], 1.0, 1.0, 1.0),  # next to it
        ([[1.2, 0.0]], 1.0, -1.0, 1.0),  # it is to drive back
        ([[-0.9, 0.0]], -1.0, -1.0, 0.0),  # 0.6 m behind the tail
        ([[-1.2, 0.0]], -1.0, -1.0, 1.0),
        ([[-0.9, 0.0]], 1.0, 1.0, 1.0),
        ([[1.2, 0.0]], 0.5, 1.0, 1.0),  # 1.4 s
        ([[1.2, 0.0]], 0.0, 1.0, 1.0),
    ],
)
def test_the_brake_by_time_to_collision_stops_less_than_0_8_s_ahead(points, speed, nominal, share) -> None:
    assert TimeToCollision().share_of(np.array(points), at(speed), (nominal, 0.0)) == share


def test_the_error_before_and_after_a_change_of_the_model_is_a_mean(monkeypatch: Patch) -> None:
    """Before it all that was reported from the finding on; after it what is reported from 10 to 20 s."""

    def finding(at: float, error: float, stage: str = "raised", number: int = 1) -> Any:
        return FINDING, finding_of(stage, robot_time=at, number=number, error=error, evidence=at, where="speed")

    take = ModelMessage(**stamp(1, period=5.0), step="take", change=1, fingerprint="f", replaces="e", from_tick=100)
    before = [finding(1.0, 9.0, "learning", 0), *(finding(at, e) for at, e in ((2.0, 1.0), (3.0, 2.0), (4.0, 6.0)))]
    later = ((9.0, 0.1), (10.0, 0.2), (14.9, 9.0), (15.0, 0.5), (20.0, 0.7), (25.0, 0.9), (25.1, 9.0))
    after = [finding(at, error, "watching", 2) for at, error in later]

    def driven(_robot: Any, _nodes: Any, periods: int, hear: Callable[[Any], None]) -> Iterator[Any]:
        assert periods == 40
        for topic, message in [*before, (MODEL, take), *after]:
            hear(ReceivedMessage(topic, "r1", message, b"", "", 0.0))
        yield tick()

    follow(monkeypatch, live, robot(changed_at=None))
    monkeypatch.setattr(live, "drive", driven)
    found = live.drive_live("nothing", 1, 2.0)
    assert (found.raised, found.before, found.where, found.taken) == (2.0, 3.0, "speed", 5.0)
    assert (found.fell, found.after) == (10.0, pytest.approx(0.7)), "after a whole stretch of 5 s"
    assert (found.findings, found.evidence) == (2, 25.1)
