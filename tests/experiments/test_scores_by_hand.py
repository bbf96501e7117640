"""What drives with a laser and by ROS come to, from records that are written down by hand."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments import ros, sensing_curves, sensing_margins
from safedpa_lab.experiments.ros_report import page_of as ros_page
from safedpa_lab.experiments.sensing_page import page_of as sensing_page
from safedpa_lab.experiments.sensing_peers import CollisionMonitor, TimeToCollision
from safedpa_lab.experiments.sensing_scenes import _outside
from safedpa_lab.experiments.sensing_scores import Score, _least, _nearest, _to
from safedpa_sim.sensing.shapes import Outline


def state(speed: float = 0.0) -> Any:
    return SimpleNamespace(footprint=(0.1, 0.3, 0.2), values=(0.0, 0.0, 0.0, speed))


@pytest.mark.parametrize("within", range(9))
def test_as_many_points_as_are_asked_for_are_a_thing(within: int) -> None:
    """At 1 m/s the disc around the nose, 0.3 m ahead with 0.2 m, is at the points 1.04 m ahead within 0.6 s."""
    points = np.array([[1.04, 0.01 * n] for n in range(within)] + [[5.0, 0.0], [1.0, 2.0], [-3.0, 0.0]])
    for least in (1, 3, 6):
        share = CollisionMonitor(1.2, least).share_of(points, state(1.0), (1.0, 0.0))
        assert share == pytest.approx(0.5 if within >= least else 1.0, abs=0.01)


@pytest.mark.parametrize(
    ("apart", "share"), [(0.45, 0.0), (0.95, 5 / 12), (1.15, 7 / 12), (1.55, 11 / 12), (1.75, 1.0)]
)
def test_the_wish_is_scaled_by_the_time_that_is_left_over_the_patience(apart: float, share: float) -> None:
    """The nose is 0.5 m ahead, and steps are 0.1 s: 0.45 m beyond it are touched after 0.5 s."""
    points = np.full((6, 2), (apart, 0.0))
    assert CollisionMonitor(1.2).share_of(points, state(1.0), (1.0, 0.0)) == pytest.approx(share)


@pytest.mark.parametrize(
    ("points", "speed", "wish", "share"),
    [
        ([[1.2, 0.0]], 1.0, 1.0, 0.0),  # 0.7 m beyond the nose
        ([[1.4, 0.0]], 1.0, 1.0, 1.0),  # 0.9 m
        ([[1.4, 0.0], [1.2, 0.1]], 1.0, 1.0, 0.0),
        ([[1.2, 0.3]], 1.0, 1.0, 1.0),  # beside it
        ([[1.2, 0.0]], 1.0, -1.0, 1.0),  # it wishes to go back
        ([[-0.9, 0.0]], -1.0, -1.0, 0.0),  # 0.6 m behind the tail
        ([[-1.2, 0.0]], -1.0, -1.0, 1.0),
        ([[-0.9, 0.0]], 1.0, 1.0, 1.0),
        ([[1.2, 0.0]], 0.5, 1.0, 1.0),  # 1.4 s
        ([[1.2, 0.0]], 0.0, 1.0, 1.0),
    ],
)
def test_the_brake_of_the_course_stops_less_than_0_8_s_before_a_thing_ahead(
    points: list[list[float]], speed: float, wish: float, share: float
) -> None:
    assert TimeToCollision().share_of(np.array(points), state(speed), (wish, 0.0)) == share


SQUARE, OTHER = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], [(3.0, 0.0), (5.0, 0.0), (5.0, 1.0), (3.0, 1.0)]


@pytest.mark.parametrize(
    ("place", "outside"),
    [((0.5, 0.5), False), ((4.0, 0.5), False), ((2.0, 0.5), True), ((0.5, 1.5), True), ((-0.1, 0.5), True)],
)
def test_a_place_is_free_where_it_lies_in_none_of_the_boxes(place: tuple[float, float], outside: bool) -> None:
    both = Outline((), (SQUARE, OTHER), ())  # type: ignore[arg-type]
    assert _outside(both, *place) is outside
    assert _outside(Outline((), (), ()), *place)


@pytest.mark.parametrize(
    ("discs", "place", "away"),
    [
        ([[3.0, 4.0, 1.0]], (0.0, 0.0), 4.0),
        ([[3.0, 4.0, 1.0], [0.0, 2.0, 0.5]], (0.0, 0.0), 1.5),
        ([[0.0, 0.2, 0.5], [0.0, 2.0, 0.5]], (0.0, 0.0), -0.3),
        ([], (0.0, 0.0), 1e3),
    ],
)
def test_the_nearest_disc(discs: list[list[float]], place: tuple[float, float], away: float) -> None:
    assert _to(np.array(discs).reshape(-1, 3), np.array(place)) == pytest.approx(away)


@pytest.mark.parametrize(("h", "least"), [([0.5, -0.25, 2.0], -0.25), ([1.0], 1.0), ([], 1e3)])
def test_where_nothing_is_there_it_is_far(h: list[float], least: float) -> None:
    assert _least(np.array(h)) == least


@pytest.mark.parametrize(
    ("wanted", "who"), [("111", 1), ("101", 2), ("100", 0), ("001", 2), ("000", None), ("", None), ("11", 1)]
)
def test_of_those_who_are_wanted_the_one_nearest_to_the_boundary_is_told(wanted: str, who: int | None) -> None:
    h = np.array([0.75, -0.25, 0.5])[: len(wanted)]
    assert _nearest(h, np.array([letter == "1" for letter in wanted], dtype=bool)) == who


def scored(seed: int, *errors: tuple[str, float, float]) -> dict[str, Any]:
    """A drive with steps of a kind, as they were hoped and as they came."""
    scores = [
        list(Score(kind, 0.1 * n, hoped, true, 0.5, -1, 0.0, (0.1, 0.3, 0.2), 0.05))
        for n, (kind, hoped, true) in enumerate(errors)
    ]
    return {"scene": "people", "load": "none", "seed": seed, "scores": scores}


BEFORE = [
    scored(1, ("obstacle", 0.3, 0.2), ("obstacle", 0.9, 0.1), ("mover", 0.4, 0.5)),
    scored(2, ("obstacle", 0.2, 0.7)),
    scored(3),
]
AFTER = [scored(4, ("obstacle", 0.1, 0.2), ("obstacle", 0.1, 0.1), ("obstacle", 0.4, 0.1)), scored(5, ("mover", 1, 1))]


@pytest.mark.parametrize(
    ("kind", "steps", "near", "largest"), [("obstacle", 5, 2, 0.4), ("mover", 1, 1, -0.1), ("hidden", 0, 0, None)]
)
def test_steps_and_drives_near_what_a_margin_covers(kind: str, steps: int, near: int, largest: float | None) -> None:
    """Of an obstacle steps below 0.5 m count, of a mover below 1 m; what is hoped farther is hoped as far as that."""
    row = sensing_margins._row(kind, BEFORE, AFTER, {"step": {}, "drive": {}})
    assert (row["steps"], row["drives_near"]) == (steps, near)
    assert row["quantiles"].get("1") == (None if largest is None else pytest.approx(largest))
    assert [item["drive"] for item in row["worst"]] == {
        "obstacle": ["people, load none, seed 1", "people, load none, seed 4"], "mover": ["people, load none, seed 1"],
    }.get(kind, [])  # fmt: skip


def test_what_fresh_drives_were_covered() -> None:
    tables = {"step": {"obstacle": 0.05}, "drive": {"obstacle": 0.3 + 1e-9}}
    row = sensing_margins._row("obstacle", BEFORE, AFTER, tables)
    assert (row["step"], row["drive"]) == (0.05, 0.3 + 1e-9)
    assert row["out"]["0.5"] == pytest.approx(0.1), "the nearer of points and movers"
    assert sensing_margins._row("mover", BEFORE, AFTER, tables)["out"]["0.5"] == pytest.approx(0.25), "grown by 0.05"
    assert "fresh" in row
    assert set(row["fresh"]) == {"step", "drive"}


@pytest.mark.parametrize("near", [(), (1,), (0, 2)])
def test_margins_of_a_laser_are_made_where_any_drive_came_near_something(
    near: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    class ReachedError(Exception):
        pass

    def calibrated(heights: Any, *_: Any) -> Any:
        raise ReachedError(str([len(one.get("obstacle", ())) for one in heights]))

    drives = [scored(n, *[("obstacle", 0.2, 0.1)] * (n + 1 if n in near else 0)) for n in range(5)]
    monkeypatch.setattr(sensing_margins, "smallest_sample", lambda _: 3)
    monkeypatch.setattr(sensing_margins, "driven", lambda *_: drives)
    monkeypatch.setattr(sensing_margins, "calibration_from_drives", calibrated)
    with pytest.raises(ReachedError if near else Exception) as told:
        sensing_margins.margins_of_sensing(3, 2, 5.0, 0.5)
    counts = [n + 1 if n in near else 0 for n in range(3)]
    assert str(told.value) == str(counts) if near else "in none the car came near anything" in str(told.value)


def test_all_goals_and_contacts_of_the_drives_that_margins_come_from(monkeypatch: pytest.MonkeyPatch) -> None:
    drives = [
        scored(n, ("obstacle", 0.2, 0.1)) | {"goals": goals, "moving": ["x"] * hits}
        for n, (goals, hits) in enumerate([(2, 0), (3, 1), (0, 0), (5, 2)])
    ]
    margin = SimpleNamespace(epsilon={"obstacle": 0.1}, drive={"obstacle": 0.2})
    monkeypatch.setattr(sensing_margins, "smallest_sample", lambda _: 2)
    monkeypatch.setattr(sensing_margins, "driven", lambda *_: drives)
    monkeypatch.setattr(sensing_margins, "calibration_from_drives", lambda *_: margin)
    told = sensing_margins.margins_of_sensing(2, 2, 5.0, 0.5)
    assert (told["goals"], len(told["moving"])) == (10, 3)
    assert [row["steps"] for row in told["rows"] if row["kind"] == "obstacle"] == [4]


def test_goals_of_those_who_are_told_everything_are_of_the_same_value(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two values with three seeds each of half a minute; goals rise from drive to drive."""

    def done(_: Any, wanted: Any, *__: Any) -> list[dict[str, Any]]:
        return [{"goals": n, "seed": one.seed, "guard": one.guard} for n, one in enumerate(wanted)]

    monkeypatch.setattr(sensing_curves, "driven", done)
    monkeypatch.setattr(
        sensing_curves, "row_of",
        lambda kind, drives, told, seconds: {"own": [d["goals"] for d in drives], "told": [d["goals"] for d in told]},
    )  # fmt: skip
    found = sensing_curves.curves_experiment([5, 6, 7], 30.0, curves={"noise": (0.01, 0.05)})
    assert [row["own"] for row in found["rows"]] == [[0, 1, 2], [3, 4, 5]]
    assert [row["told"] for row in found["rows"]] == [[6, 7, 8], [9, 10, 11]]
    assert [row["goals_a_minute_told_everything"] for row in found["rows"]] == [14.0, 20.0]


def test_contacts_elsewhere_are_those_of_all_rows() -> None:
    def row(guard: str, elsewhere: int, which: list[str]) -> dict[str, Any]:
        return {
            "scene": "people", "guard": guard, "drives": 9, "drives_in_which_the_car_moved_into_something": 2,
            "share_95": (0.01, 0.5), "which": which, "of_them_it_did_not_drive_towards": elsewhere,
            "touched_while_it_stood": 4, "goals_a_minute": 1.26, "goals_beside_perfect_knowledge": None,
            "metres_a_minute": 33.4,
        }  # fmt: skip

    result = {"seeds": [1, 2, 3], "loads": ["none"], "seconds": 5.0,
              "rows": [row("told", 2, ["a"]), row("nothing", 3, ["b", "c"])]}  # fmt: skip
    page = sensing_page(result)
    assert "Into what (in 5 of these car or load" in page
    assert page.count("\n- people, ") == 3
    assert "| 9 | 2 | 1.0 to 50.0 % | 4 | 1.3 |  | 33 |" in page


def drives_of(tells: list[tuple[int, int]], count: int, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Of the ROS experiment with as many seeds and three faults, nothing of it driven."""
    row = {"collisions": 0, "reached": 1, "moved": 2.0, "commands": 3, "gateway_brakes": 4, "driver_brakes": 5}
    chains: list[int] = []

    def blind(seeds: Any, _: float, tell: Any) -> list[dict[str, Any]]:
        tell(2)
        tell(len(seeds))
        return [{"seed": seed, **row, "collisions": 1} for seed in seeds]

    def bare(*_: float) -> list[float]:
        chains.append(1)
        return [100.0, 300.0]

    monkeypatch.setattr(ros, "services", lambda _: nullcontext(None))
    monkeypatch.setattr(ros, "bare_times", bare)
    monkeypatch.setattr(
        ros, "_undisturbed", lambda _loop, _folder, seed, _: {"seed": seed, **row, "sense_to_act": [(0.03, 0.01)] * 2}
    )
    monkeypatch.setattr(ros, "unfiltered_drives", blind)
    monkeypatch.setattr(ros, "run_fault", lambda fault, seed: {"fault": fault, "seed": seed})
    found = ros.ros_experiment(list(range(10, 10 + count)), 30.0, ("a", "b", "c"), lambda *one: tells.append(one))
    assert len(chains) == -(-count // 5)
    return found


@pytest.mark.parametrize("count", [2, 6, 11])
def test_progress_of_drives_by_ros_comes_to_its_end_step_by_step(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    tells: list[tuple[int, int]] = []
    found = drives_of(tells, count, monkeypatch)
    whole = 2 * count + 3
    assert {one[1] for one in tells} == {whole}
    with_filter = list(range(1, count + 1))
    assert [one[0] for one in tells] == [*with_filter, count + 2, 2 * count, *range(2 * count + 1, whole + 1)]
    assert (found["with_filter"]["drives"], found["with_filter"]["drives_with_a_collision"]) == (count, 0)
    assert found["without_filter"]["which"] == list(range(10, 10 + count))
    assert [one["seed"] for one in found["faults"]] == [10 + n % count for n in range(3)]
    assert found["sense_to_act_ms"]["both"] == {"samples": 2 * count, "p50": 30.0, "p99": 30.0}
    assert found["sense_to_act_ms"]["bare_chain"]["samples"] == 2 * -(-count // 5)
    assert (found["sense_to_act_ms"]["bare_chain"]["p50"], found["seeds"]) == (0.2, [10, 9 + count])


@pytest.mark.parametrize("faults", [0, 2])
def test_the_page_by_ros_has_a_table_of_faults_with_its_head(faults: int) -> None:
    row = {
        "drives": 7, "drives_with_a_collision": 2, "collisions": 3, "goals": 5, "metres_a_minute": 41.6,
        "periods_braked_by_the_gateway": 11, "periods_braked_by_the_driver": 13, "share_95": (0.1, 0.256),
    }  # fmt: skip
    latency = {"p50": 1.25, "p99": 2.0, "samples": 17}
    names = ("through_the_gateway", "waiting_for_its_turn", "both", "bare_chain")
    fault = {
        "fault": "cut",
        "speed_before": 1.5,
        "stood_after": None,
        "stopping_way": 0.25,
        "told": "",
        "collisions": 3,
    }
    result = {
        "seeds": (1, 7), "seconds": 30.0, "command": "c", "date": "d", "with_filter": row, "without_filter": row,
        "sense_to_act_ms": dict.fromkeys(names, latency), "faults": [fault] * faults,
    }  # fmt: skip
    page = ros_page(result)
    for line in ("| drives of 30 s | 7 | 7 |", "| drives with a collision | 2 | 2 |", "| collisions | 3 | 3 |",
                 "| goals reached | 5 | 5 |", "| m a minute | 42 | 42 |"):  # fmt: skip
        assert line in page
    assert "at most 25.6 % of such drives" in page
    table = page.partition("## Faults")[2]
    head = "| fault | speed, m/s | stands after, s | m | told | collisions |\n|---|---|---|---|---|---|\n"
    wanted = head + "| cut | 1.50 |  | 0.25 | nothing; it drives on | 3 |\n" * faults
    assert table == (f"\n\nEach in a drive of its own, while the car drives.\n\n{wanted}" if faults else "")
