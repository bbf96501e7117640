"""What drives with a laser, by ROS, on recordings and of tuned models come to, from records written down by hand."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments import fleet_screen, hidden_summary, real_logs, ros, sensing_curves, sensing_margins
from safedpa_lab.experiments.fleet_diagnosis import judged_fleet
from safedpa_lab.experiments.hidden_page import page_of as hidden_page
from safedpa_lab.experiments.real_logs_targets import folds_target, targets_of
from safedpa_lab.experiments.ros_report import page_of as ros_page
from safedpa_lab.experiments.sensing_page import page_of as sensing_page
from safedpa_lab.experiments.sensing_peers import CollisionMonitor, TimeToCollision
from safedpa_lab.experiments.sensing_scenes import _outside
from safedpa_lab.experiments.sensing_scores import Score, _least, _to
from safedpa_lab.experiments.statistics import wilson_interval
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


@pytest.mark.parametrize(
    ("errors", "together"), [([(4.0, 1.0), (2.0, 1.0), (2.0, 0.5)], -0.6875), ([(1.0, 2.0)], 1.0), ([], None)]
)
def test_errors_of_the_logs_that_were_left_out_are_added_up(
    errors: list[tuple[float, float]], together: float | None
) -> None:
    rows = [{"unseen_before": before, "unseen_after": after} for before, after in errors]
    assert real_logs._together(rows) == together


def test_how_often_an_effect_was_added_is_counted_most_frequent_first() -> None:
    rows: list[dict[str, Any]] = [
        {"added": ["a"]},
        {"added": ["b", "a"]},
        {"added": []},
        {"added": ["b"]},
        {"added": ["c", "b"]},
    ]
    assert list(real_logs._stable(rows).items()) == [("b", 3), ("a", 2), ("c", 1)]


@pytest.mark.parametrize(("errors", "change"), [((4.0, 3.0, 1.0), -0.75), ((0.0, 0.0), 0.0), ((2.0,), 0.0)])
def test_the_change_of_the_error_is_from_the_first_stage_to_the_last(
    errors: tuple[float, ...], change: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    def accepted(effect: str, decision: str, *alike: str) -> Any:
        return SimpleNamespace(effect=effect, decision=decision, indistinguishable_from=alike)

    stages = [SimpleNamespace(heldout_error=error, runs_improved=n) for n, error in enumerate(errors)]
    report: Any = SimpleNamespace(
        stages=stages, parameters={"a.x": SimpleNamespace(value=1.23456, std=None),
                                   "a.y": SimpleNamespace(value=2.0, std=0.123456)},
        candidates=[accepted("a", "accepted", "b"), accepted("c", "accepted"), accepted("d", "rejected", "e")],
        verdict="model", added=("a",), unexplained=None,
    )  # fmt: skip
    monkeypatch.setattr(real_logs, "as_document", lambda _: None)
    monkeypatch.setattr(real_logs, "story_of", lambda _: SimpleNamespace(lead="so"))
    found = real_logs._summary(report)
    assert (found["change"], found["errors"]) == (change, list(errors))
    assert found["runs_improved"] == list(range(1, len(errors)))
    assert found["parameters"] == {"a.x": [1.235, None], "a.y": [2.0, 0.1235]}
    assert found["indistinguishable"] == {"a": ["b"]}


@pytest.mark.parametrize(
    ("row", "measured", "met"),
    [
        ({"name": "", "added": ["a", "b", "c"], "change": -0.6}, "-60.0 % with 3 effects", True),
        ({"name": "", "added": ["a"], "change": -0.59}, "-59.0 % with 1 effects", False),
        ({"name": "x10-11-12.csv", "added": ["a", "b"], "unseen_change": -0.3, "verdict": "model"},
         "-30.0 % with 2 effects", True),
        ({"name": "x10-11-12.csv", "added": [], "unseen_change": -0.29, "verdict": "model"},
         "-29.0 % with 0 effects", False),
        ({"name": "x10-11-12.csv", "added": [], "unseen_change": 0.5, "verdict": "undecided"}, "undecided", True),
    ],
)  # fmt: skip
def test_targets_of_the_car(row: dict[str, Any], measured: str, met: bool) -> None:
    (found,) = targets_of([{"part": "car", **row}])
    assert (found["measured"], found["met"]) == (measured, met)
    assert found["subject"] == ("car, without 10-11-12" if row["name"] else "car, all logs")


@pytest.mark.parametrize(("after", "met"), [(1.4, True), (1.42, False)])
def test_a_target_where_it_is_told_that_it_holds(after: float, met: bool) -> None:
    row = {
        "part": "car", "name": "10-11-12.csv", "added": [], "unseen_change": 0.0, "verdict": "model",
        "unseen_told": 0.25, "unseen_where_told": (2.0, after),
    }  # fmt: skip
    found = targets_of([row])[1]
    assert (found["measured"], found["met"]) == (f"{50 * after - 100:+.1f} %; 25 % of its predictions lie there", met)


@pytest.mark.parametrize(
    ("added", "errors", "met", "measured"),
    [
        (["coulomb_friction"], [2.0, 1.09, 0.5], [True, True, True], ["coulomb_friction", "-45.5 %", "none"]),
        (["coulomb_friction", "torque_lag"], [2.0, 1.2], [True, False, False], ["", "-40.0 %", "torque_lag"]),
        (["drag", "torque_delay", "torque_offset"], [2.0, 1.0], [False, True, False],
         ["drag", "-50.0 %", "torque_delay, torque_offset"]),
        ([], [2.0], [False, False, True], ["nothing", "+0.0 %", "none"]),
    ],
)  # fmt: skip
def test_targets_of_the_pendulum(added: list[str], errors: list[float], met: list[bool], measured: list[str]) -> None:
    found = targets_of([{"part": "pendulum", "added": added, "errors": errors}])
    assert [one["met"] for one in found] == met
    for one, said in zip(found, measured, strict=True):
        assert said in one["measured"]


@pytest.mark.parametrize(
    ("name", "added", "met"),
    [
        ("Bowling", [], True), ("bowling 2", ["drag"], False), ("Whiffle", ["quadratic_drag", "wind"], True),
        ("whiffle", ["wind", "quadratic_drag"], False), ("whiffle", [], False), ("tennis", ["drag"], None),
    ],
)  # fmt: skip
def test_targets_of_the_balls(name: str, added: list[str], met: bool | None) -> None:
    found = targets_of([{"part": "balls", "name": name, "added": added, "verdict": "nothing"}])
    assert [one["met"] for one in found] == ([] if met is None else [met])


@pytest.mark.parametrize(("change", "met"), [(-0.6, True), (-0.5999, False), (0.1, False)])
def test_the_target_of_all_logs_together(change: float, met: bool) -> None:
    assert folds_target(change)["met"] is met


def test_limits_of_a_screen_are_of_the_healthy_cars_of_the_same_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors of healthy cars rise from 1; those of the effects behind them are told over the limit of their own."""
    cases: list[Any] = []

    def errors(found: Any, _: Any) -> list[float]:
        cases.extend(found)
        return [float(n + 1) for n in range(len(found))]

    monkeypatch.setattr(fleet_screen, "_errors", errors)
    told = fleet_screen.fleet_screen(0, 6)
    healthy, ill = cases[:6], cases[6:]
    assert all(not case.effects for case in healthy)
    assert (told["healthy"], told["effects"]) == (6, len(ill))
    assert {row["effect"]: row["error"] for row in told["rows"]} == {
        next(iter(case.effects)): 7.0 + n for n, case in enumerate(ill)
    }
    for drive, limit in told["limits"].items():
        own = [n + 1.0 for n, case in enumerate(healthy) if case.drive == drive]
        assert len(own) == 6 // len(told["limits"])
        assert limit == pytest.approx(float(np.quantile(own, told["quantile"])))
    assert told["missed"] == [row["effect"] for row in told["rows"] if row["over_limit"] <= 1.0] == []


def hidden(suite: str, case: str, *effects: str, right: bool = True, wrong: tuple[str, ...] = ()) -> Any:
    return SimpleNamespace(
        suite=suite, case=case, hidden=effects, right=right, first_named=True, all_named=True, wrong=wrong,
        false_laws=(), deviations=(), error_ratio=1.0, seconds=1.0, processor_seconds=1.0, verdict="model",
        added=("a",), told=("b",),
    )  # fmt: skip


def test_effects_have_a_row_where_one_alone_is_hidden() -> None:
    outcomes = [
        hidden("one", "1", "drag"), hidden("one", "2", "drag", right=False), hidden("one", "3", "tow"),
        hidden("two", "4", "drag", "tow", wrong=("x",)), hidden("two", "5", "lag"), hidden("none", "6"),
    ]  # fmt: skip
    found = hidden_summary.summary(("one", "two", "none"), outcomes)
    assert [(row["suite"], row["cases"]) for row in found["suites"]] == [("one", 3), ("two", 2), ("none", 1)]
    assert [(row["suite"], row["effect"], row["cases"], row["right"]["hits"]) for row in found["effects"]] == [
        ("one", "drag", 2, 1), ("one", "tow", 1, 1), ("two", "lag", 1, 1),
    ]  # fmt: skip
    assert [(row["case"], row["added"]) for row in found["missed"]] == [("2", ["a", "b"]), ("4", ["a", "b"])]


@pytest.mark.parametrize("count", [1, 4])
def test_the_page_of_hidden_effects_tells_how_many_cases_there_are(count: int) -> None:
    found = hidden_summary.summary(("one",), [hidden("one", str(n), "drag") for n in range(count)])
    document = {"versions": {"numpy": "2"}, "seeds": [1, 2], "date": "2026-01-02T03", "cases": [{}] * count, **found}
    assert f"{count} cases, seeds 1, 2; finished 2026-01-02; numpy 2." in hidden_page(document)


def test_a_fleet_is_judged_robot_by_robot_and_group_by_group() -> None:
    """Seven robots: three drag and are found; one tows and is not; two of three healthy ones are called ill."""
    truth: dict[str, Any] = {f"d{n}": {"drag": {"c": 1.0}} for n in range(3)}
    truth |= {"t": {"tow": {"m": 2.0}}, **{f"h{n}": {} for n in range(3)}}

    def effect(name: str, *alike: str) -> dict[str, Any]:
        return {"effect": name, "indistinguishable_from": alike}

    def group(kind: str, *robots: str, effects: tuple[Any, ...] = ()) -> dict[str, Any]:
        return {"kind": kind, "robots": list(robots), "effects": list(effects)}

    found = {f"d{n}": 1.0 + 0.5 * n for n in range(3)}
    document = {
        "groups": [
            group("missing", "d0", "d1", "d2", effects=(effect("drag"),)), group("nothing", "t", "h0"),
            group("missing", "h1", effects=(effect("lag"),)), group("unexplained", "h2"),
        ],
        "robots": [
            {"robot": name, "found": [{"effect": "drag", "parameters": {"c": {"value": found[name], "std": 0.25}}}]
             if name in found else []}
            for name in truth
        ],
        "common": {"effects": [{"effect": "a", "confirmed": {"holds": True}},
                               {"effect": "b", "confirmed": {"holds": False}}]},
        "false_discovery": 0.05,
    }  # fmt: skip
    judged = judged_fleet(document, truth)
    assert judged["hidden"] == {"hits": 3, "of": 4, "interval_95": [round(v, 4) for v in wilson_interval(3, 4)]}
    assert judged["healthy"] == {"hits": 1, "of": 3, "interval_95": [round(v, 4) for v in wilson_interval(1, 3)]}
    assert (judged["groups_hidden"], judged["groups_right"], judged["groups_false"]) == (2, 1, 2)
    assert (judged["within_two_deviations"]["hits"], judged["within_two_deviations"]["of"]) == (2, 3)
    assert (judged["largest_deviation"], judged["common_named"]) == (4.0, ["a"])
    assert [row["robot"] for row in judged["wrong"]] == ["t", "h1", "h2"]
