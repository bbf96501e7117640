"""What experiments add up from drive to drive, from drives that are written down by hand."""

from __future__ import annotations

import dataclasses
from collections import Counter
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments import (
    car_episodes,
    car_margin,
    delayed_drives,
    fleet_diagnosis,
    hidden_summary,
    margins,
    pendulum_payload,
    pendulum_story,
)
from safedpa_lab.experiments.car_conditions import Conditions
from safedpa_lab.experiments.car_drives import Drive, cut_at_contact
from safedpa_lab.experiments.delayed_drives import DelayedDrives
from safedpa_lab.experiments.live_drive import LiveDrive, _Notes
from safedpa_lab.experiments.margin_drives import DriveResult
from safedpa_lab.experiments.statistics import coverage_row, mean_interval, wilson_interval


def result(seed: int, heights: dict[str, np.ndarray], **changes: Any) -> DriveResult:
    usual: dict[str, Any] = {"goals": 2, "collisions": 0, "ticks": 100, "statuses": {"passed": 3}, "least_h": 0.5}
    return DriveResult(seed, heights, **{**usual, **changes})


def test_drives_behind_margins() -> None:
    drives = [
        result(1, {}), result(2, {}, goals=0, collisions=2, least_h=-0.1, statuses={"fallback": 1, "passed": 1}),
        result(3, {}, goals=4, collisions=1),
    ]  # fmt: skip
    assert margins._driving(drives, 30.0) == {
        "drives": 3, "collisions": 3, "goals": 6, "goals_a_minute": mean_interval(np.array([4.0, 0.0, 8.0])),
        "statuses": {"fallback": 1, "passed": 7}, "least_h": -0.1,
    }  # fmt: skip


def test_steps_that_margins_cover_are_counted_of_drives_that_came_near() -> None:
    """Four drives: two came near the wall, one has no step there, one never heard of it."""
    near = np.array([[0.5, 0.4, 0.0, 0.0], [0.3, 0.1, 0.0, 0.0]])
    heights = [{"wall": near}, {"wall": near[:1]}, {"wall": np.zeros((0, 4))}, {}]
    ceiling: Any = SimpleNamespace(errors=lambda _kind, steps: steps[:, 0] - steps[:, 1])
    told: list[float] = []

    def covered_shares(drives: Any, kind: str, margin: float, _: Any) -> np.ndarray:
        assert (len(drives), kind) == (4, "wall")
        told.append(margin)
        return np.array([1.0, 0.5, 1.0, 1.0])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(margins, "covered_shares", covered_shares)
        rows = margins._counted(
            [result(n, one) for n, one in enumerate(heights)], {"one": {"wall": 0.1}, "two": {"wall": 0.2}}, ceiling
        )["covered"]
    assert (rows["wall"]["drives"], rows["wall"]["drives_near"]) == (4, 2)
    assert told == [0.1, 0.2]
    assert rows["wall"]["two"] == coverage_row(np.array([1.0, 0.5, 1.0, 1.0]), 0.2)


@pytest.mark.parametrize("sizes", [{"wall": 3, "hill": 0, "sea": 2}, {"wall": 1}, {}])
def test_a_drive_that_is_kept_is_read_again_as_it_was(sizes: dict[str, int], tmp_path: Any) -> None:
    random = np.random.default_rng(1)
    drive = result(7, {kind: random.random((size, 4)) for kind, size in sizes.items()}, goals=3, collisions=1)
    margins._keep(tmp_path / "7.npz", drive)
    again = margins._kept(tmp_path / "7.npz")
    assert list(again.heights) == list(sizes)
    for kind, heights in drive.heights.items():
        np.testing.assert_array_equal(again.heights[kind], heights)
    assert dataclasses.replace(again, heights={}) == dataclasses.replace(drive, heights={})
    assert [path.name for path in tmp_path.iterdir()] == ["7.npz"]


@pytest.mark.parametrize("short", [None, 0, 1])
def test_without_all_drives_of_every_kind_no_margin_is_made_and_it_is_told_how_many_there_are(
    short: int | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    kinds = list(margins.KINDS)
    cases: Any = SimpleNamespace(
        out=tmp_path, seconds=12.0, drives=4, first=3, fresh=2, skip=0, coverage=0.9, settings=None
    )

    def made(folder: Any, orders: Any, *_: Any) -> list[DriveResult]:
        part = folder.name.removeprefix("calibration-")
        missing = short is not None and part == kinds[short]
        return [result(n, {}) for n in range(len(orders) - missing)]

    reached: list[int] = []

    class ReachedError(Exception):
        pass

    def joined(tables: Any) -> Any:
        reached.append(len(tables))
        raise ReachedError

    monkeypatch.setattr(margins, "_driven", made)
    monkeypatch.setattr(margins, "DriveOrder", lambda *given: given)
    monkeypatch.setattr(margins, "_calibrated", lambda *_: None)
    monkeypatch.setattr(margins, "_joined", joined)
    with pytest.raises(ReachedError) if short is None else nullcontext():
        row = margins._of_robot(cases, "car", None, 0.0, None)  # type: ignore[arg-type]
        assert row == {"drives": 4 * len(kinds) - 1}
    assert reached == ([len(kinds)] if short is None else [])


@pytest.mark.parametrize(
    ("groups", "right", "count"),
    [
        ([{"a", "b"}, {"c"}], "abc", 2),
        ([{"a", "b"}, {"c"}], "ab", 1),
        ([{"a", "b"}, {"c"}], "bc", 1),  # of the two robots one is wrong
        ([{"a"}, {"b"}, {"c"}], "abc", 1),
        ([{"a", "b", "c"}], "abc", 0),
        ([{"a", "b"}, {"c"}], "", 0),
    ],
)
def test_a_kind_of_hidden_effects_is_right_where_its_robots_are_one_group_and_each_is_right(
    groups: list[set[str]], right: str, count: int
) -> None:
    hidden = {"a": ["drag"], "b": ["drag"], "c": ["tow"], "d": []}
    rows = [{"robot": name, "hidden": own, "right": name in right} for name, own in hidden.items()]
    told = [{"robots": sorted(names), "kind": "missing"} for names in groups] + [{"robots": ["d"], "kind": "nothing"}]
    assert fleet_diagnosis._right_groups(rows, told) == count
    assert fleet_diagnosis._kinds(rows) == 2


@pytest.mark.parametrize(("robots", "some"), [(["a"], True), (["b"], False), (["b", "a"], True), (["b", "c"], False)])
def test_a_group_has_something_hidden_where_any_of_its_robots_has(robots: list[str], some: bool) -> None:
    assert fleet_diagnosis._any_hidden({"robots": robots}, {"a": {"drag": {}}, "b": {}, "c": {}}) is some


@pytest.mark.parametrize("goal_at", [None, 2])
def test_an_episode_of_the_car_is_counted_to_its_goal(goal_at: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    statuses = ["passed", "corrected", "fallback", "disabled", "relaxed", "passed"]
    robot = SimpleNamespace(collisions=["r1 and a wall", "again"], goals_reached=0, tick=6, trajectory_hash="t")
    robot.values, robot.goal = (0.0, 0.0, 0.0, 0.0), (0.0, 4.0)

    def driven(*_: Any) -> Any:
        for number, status in enumerate(statuses):
            robot.goals_reached = int(goal_at is not None and number >= goal_at)
            verdict = SimpleNamespace(status=status, h_now=0.1 * (5 - number), predicted=())
            yield SimpleNamespace(verdict=verdict, state=None)

    monkeypatch.setattr(car_episodes, "drive", driven)
    monkeypatch.setattr(car_episodes, "nodes_of", lambda *_: None)
    monkeypatch.setattr(Conditions, "nodes", lambda *_: None)
    monkeypatch.setattr(Conditions, "robot", lambda *_: robot)
    counted = SimpleNamespace(see=lambda *_: None, counts={"wall": [1, 2]})
    monkeypatch.setattr(car_episodes, "CoverageCount", lambda *_: counted)
    group: Any = SimpleNamespace(method=None, folder=None, settings=None, margin=None, load="none", ticks=6, seeds=(4,))
    group.conditions = Conditions()
    (found,) = car_episodes.run_group(group)
    seen = statuses if goal_at is None else statuses[: goal_at + 1]
    assert (found.success, found.safe, found.collisions) == (goal_at is not None, False, 2)
    assert (found.changed, found.statuses) == (3 if goal_at is None else 2, dict(sorted(Counter(seen).items())))
    assert (found.first_collision, found.covered) == ("r1 and a wall", {"wall": [1, 2]})
    assert found.least_h == pytest.approx(0.1 * (6 - len(seen)))
    robot.collisions = []
    assert car_episodes.run_group(group)[0].safe


@pytest.mark.parametrize("collisions", [[0, 0, 2], [3, 0, 1], [0, 0, 0]])
def test_drives_under_a_delay_are_added_up(collisions: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    robots = [SimpleNamespace(collisions=["it"] * count, goals_reached=n + 1) for n, count in enumerate(collisions)]
    loads: list[str] = []

    def robot(seed: int, load: str) -> Any:
        loads.append(load)
        return robots[seed - 10]

    def driven(_known: Any, _margin: Any, own: Any, *_: Any) -> Any:
        for status in ("passed", "corrected", "passed"):
            yield SimpleNamespace(verdict=SimpleNamespace(status=status, h_now=-0.1 * own.goals_reached))

    monkeypatch.setattr(delayed_drives, "_driven", driven)
    lateness: Any = SimpleNamespace(model=lambda name: name, robot=robot)
    told: list[tuple[int, int]] = []
    found = delayed_drives.delayed_drives(
        lateness, 3, 10, loads=("none", "box"), on_drive=lambda *done: told.append(done)
    )
    assert found == DelayedDrives(
        lateness, 3, sum(map(bool, collisions)), sum(collisions), 6, -0.1 * 3, Counter({"passed": 6, "corrected": 3})
    )
    assert (loads, told) == (["none", "box", "none"], [(1, 3), (2, 3), (3, 3)])


@pytest.mark.parametrize("errors", [[0.1, 0.5, 0.3], [0.5], [0.2, 0.2]])
def test_steps_are_covered_whose_error_is_at_most_the_margin(
    errors: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    count = car_margin.CoverageCount.__new__(car_margin.CoverageCount)
    count._margin = SimpleNamespace(epsilon={"wall": 0.3})  # type: ignore[assignment]
    count._expected, count._barriers, count.counts, count._scene = None, (), {}, None  # type: ignore[assignment]
    monkeypatch.setattr(car_margin, "_barriers", lambda *_: ())
    left = iter(errors)
    monkeypatch.setattr(car_margin, "worst_errors", lambda *_: {"wall": next(left)})
    state: Any = SimpleNamespace(values=(0.0,))
    for _ in range(len(errors) + 1):  # of the first state nothing was expected
        count.see(state, ((0.0,),))
    assert count.counts == {"wall": [sum(error <= 0.3 for error in errors), len(errors)]}
    count._expected = None
    count.see(state, ())
    count.see(state, ((0.0,),))
    assert count.counts["wall"][1] == len(errors), "where nothing was expected nothing is covered"


@pytest.mark.parametrize(("counts", "kept"), [((0, 0, 0), 3), ((0, 1, 1), 1), ((1, 1, 2), 0), ((0, 0, 1), 2)])
def test_a_drive_is_cut_at_its_first_contact(counts: tuple[int, ...], kept: int) -> None:
    messages: Any = tuple(SimpleNamespace(collisions=count) for count in counts)
    found = cut_at_contact(Drive(messages, ("a", "b", "c")))
    assert (len(found.messages), found.loads) == (kept, ("a", "b", "c")[:kept])


def test_the_error_before_and_after_a_change_of_the_model_is_a_mean() -> None:
    """Before it all that was told from the finding on; after it what is told from 10 to 20 s."""
    notes = _Notes.__new__(_Notes)
    notes._found, notes._errors, notes._later = LiveDrive("hitch", 1), [], []

    def told(at: float, error: float, stage: str = "raised", number: int = 1) -> None:
        message: Any = SimpleNamespace(
            number=number, evidence=at, robot_time=at, stage=stage, error=error, where="speed"
        )
        notes._finding(message)

    told(1.0, 9.0, "learning", 0)
    assert (notes._found.raised, notes._found.before) == (None, 0.0)
    for at, error in ((2.0, 1.0), (3.0, 2.0), (4.0, 6.0)):
        told(at, error)
    assert (notes._found.raised, notes._found.before, notes._found.where) == (2.0, 3.0, "speed")
    notes._found.taken = 5.0
    for at, error in ((9.0, 0.1), (10.0, 0.2), (14.9, 9.0), (15.0, 0.5), (20.0, 0.7), (25.0, 0.9), (25.1, 9.0)):
        told(at, error, "watching", 2)
    assert notes._found.fell == 10.0, "after a whole stretch of 5 s"
    assert notes._found.after == pytest.approx(0.7)
    assert (notes._found.findings, notes._found.evidence, notes._found.before) == (2, 25.1, 3.0)


def test_payloads_named_within_their_deviations_and_false_alarms(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [
        {"mass": 0.0, "first": None, "within": None, "added": []},
        {"mass": 0.0, "first": "tow", "within": None, "added": ["tow"]},
        {"mass": 0.0, "first": "drag", "within": None, "added": ["drag"]},
        {"mass": 0.1, "first": "tip_mass", "within": True, "added": ["tip_mass"]},
        {"mass": 0.1, "first": "tip_mass", "within": False, "added": ["tip_mass"]},
        {"mass": 0.2, "first": "drag", "within": None, "added": ["drag"]},
        {"mass": 0.2, "first": "tip_mass", "within": True, "added": ["tip_mass"]},
    ]
    workers = SimpleNamespace(map=lambda *_: rows)
    monkeypatch.setattr(pendulum_payload, "Workers", lambda _: nullcontext(workers))
    monkeypatch.setattr(pendulum_payload, "identified_pendulum", lambda _: SimpleNamespace(settings={}))
    monkeypatch.setattr(pendulum_payload, "write_model", lambda _: "")
    cases: Any = SimpleNamespace(data=None, runs=2, seconds=1.0, masses=(0.1, 0.2), seeds=(1, 2), processes=1)
    found = pendulum_payload.payload_cases(cases)
    assert (found["first"], found["within_two_deviations"], found["cases"], found["false_alarms"]) == (3, 2, 4, 2)


@pytest.mark.parametrize("rooms", [(0.2, -0.1, 0.0, 0.4), (-0.3,), (0.1, 0.2)])
def test_episodes_of_the_pendulum_within_its_corridor(rooms: tuple[float, ...]) -> None:
    model: Any = SimpleNamespace(effects=[SimpleNamespace(name="tip_mass")])
    margin: Any = SimpleNamespace(epsilon={"corridor": 0.05})
    outcomes = [{"room": room, "reach": 1.0, "corrected": 0.5, "relaxed": 0.0} for room in rooms]
    row = pendulum_story._row((model, margin), outcomes)
    safe = sum(room >= 0.0 for room in rooms)
    assert (row["episodes"], row["safe"], row["least_room"]) == (len(rooms), safe, min(rooms))
    assert row["interval_safe"] == list(wilson_interval(safe, len(rooms)))
    assert (row["corrected"], row["reach"], row["margin"]) == (0.5, 1.0, 0.05)


@pytest.mark.parametrize("known", [0, 1, 2])
def test_ratios_and_processor_times_are_told_where_there_is_one(known: int) -> None:
    """NaN: none was measured."""

    def outcome(number: int) -> Any:
        measured = 1.25 if number < known else float("nan")
        return SimpleNamespace(
            hidden=("drag",), right=True, first_named=True, all_named=True, wrong=(), false_laws=(),
            deviations=(0.5,) * (number < known), error_ratio=measured, seconds=1.0, processor_seconds=measured,
        )  # fmt: skip

    row = hidden_summary._row("one", "drag", [outcome(0), outcome(1), outcome(2)])
    value = 1.25 if known else None
    for name in ("error_ratio_median", "error_ratio_largest", "processor_seconds_median", "processor_seconds_largest"):
        assert row[name] == value
    for name in ("error_ratio_within", "parameters_within_two"):
        assert (row[name] is None) == (known == 0)
    assert not known or row["parameters_within_two"]["of"] == known
