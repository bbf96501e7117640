"""The figures of experiments' tables, from outcomes that are written down by hand, each with another count."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.safety.shipped import settings_named
from safedpa_lab.experiments import car_margin, hidden_summary, meeting, safety
from safedpa_lab.experiments.fleet_diagnosis import _deviations, _robot
from safedpa_lab.experiments.statistics import clopper_pearson_interval, wilson_interval


def test_how_many_fresh_errors_a_margin_covers() -> None:
    margin: Any = SimpleNamespace(epsilon={"wall": 0.2}, theorem={"wall": 0.5})
    fresh = car_margin.StepErrors({"wall": np.array([-0.1, 0.2, 0.3, 0.5, 0.6])}, {})
    row = car_margin.coverage_of(margin, fresh)["wall"]
    assert (row["steps"], row["largest_error"]) == (5, 0.6)
    for name, epsilon, covered in (("conformal", 0.2, 2), ("theorem", 0.5, 4)):
        told = row[name]
        assert (told["epsilon"], told["covered"], told["share"]) == (epsilon, covered, covered / 5)
        assert told["interval_95"] == list(wilson_interval(covered, 5))


def test_the_worst_error_of_each_kind_is_where_the_model_hoped_most() -> None:
    def barrier(kind: str, *rise: float) -> Any:
        return SimpleNamespace(kind=kind, values=lambda state: np.array(rise) * state[0])

    barriers = [barrier("wall", 1.0, 3.0), barrier("wall", -2.0), barrier("hill", -1.0), barrier("sea")]
    found = car_margin.worst_errors(barriers, np.array([0.75]), np.array([0.5]))
    assert found == {"wall": 0.75, "hill": -0.25}


@pytest.mark.parametrize("steps", [98, 99])
def test_a_margin_of_99_of_100_wants_99_steps_of_every_kind(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 99 the largest one; of the theorem's errors likewise, and none below 0."""
    monkeypatch.setattr(car_margin, "fingerprint", lambda _: "0123456789ab")
    values, model = -0.01 * np.arange(steps, 0, -1.0), SimpleNamespace(period=0.05)
    errors = car_margin.StepErrors(
        {"wall": np.arange(150.0), "sea": values}, {"wall": np.arange(99.0), "sea": 2.0 - values}
    )
    if steps < 99:
        with pytest.raises(Exception, match="got 98 steps, wanted at least 99"):
            car_margin.margin_of(model, errors, "2026-01-01")  # type: ignore[arg-type]
        return
    found = car_margin.margin_of(model, errors, "2026-01-01")  # type: ignore[arg-type]
    assert (found.transitions, found.coverage, found.period) == (99, 0.99, 0.05)
    assert found.epsilon == {"wall": 149.0, "sea": 0.0}
    assert found.theorem == {"wall": 98.0, "sea": pytest.approx(2.99)}


def outcome(**changes: Any) -> Any:
    usual = {
        "suite": "one", "case": "a", "hidden": (), "added": (), "told": (), "verdict": "model", "right": True,
        "first_named": True, "all_named": True, "wrong": (), "false_laws": (), "deviations": (), "error_ratio": 1.0,
        "seconds": 1.0, "processor_seconds": float("nan"),
    }  # fmt: skip
    return SimpleNamespace(**usual | changes)


def test_a_row_of_hidden_effects() -> None:
    outcomes = [
        outcome(hidden=("drag",), deviations=(0.5, -2.0), error_ratio=1.1, seconds=4.0, processor_seconds=3.0),
        outcome(hidden=("drag",), deviations=(-2.5,), error_ratio=1.5, right=False, first_named=False, seconds=9.0),
        outcome(wrong=("tow", "wind"), error_ratio=float("nan"), all_named=False, seconds=2.0, processor_seconds=1.0),
        outcome(hidden=("lag",), false_laws=("x",), right=False, all_named=False, error_ratio=1.2),
    ]
    row = hidden_summary._row("one", "all", outcomes)
    counts = {name: (value["hits"], value["of"]) for name, value in row.items() if isinstance(value, dict)}
    assert counts == {
        "right": (2, 4), "named_first": (3, 4), "all_named": (2, 4), "wrong_additions": (1, 4), "false_laws": (1, 4),
        "parameters_within_two": (2, 3), "error_ratio_within": (1, 3),
    }  # fmt: skip
    assert row["right"]["interval_95"] == [round(end, 4) for end in wilson_interval(2, 4)]
    assert (row["cases"], row["error_ratio_median"], row["error_ratio_largest"]) == (4, 1.2, 1.5)
    assert (row["seconds_median"], row["seconds_largest"]) == (3.0, 9.0)
    assert (row["processor_seconds_median"], row["processor_seconds_largest"]) == (2.0, 3.0)


def test_where_nothing_is_hidden_nothing_is_named() -> None:
    row = hidden_summary._row("one", "none", [outcome(), outcome(wrong=("tow",))])
    assert row["named_first"] is None
    assert row["all_named"] is None
    assert row["parameters_within_two"] is None
    assert (row["wrong_additions"]["hits"], row["processor_seconds_median"]) == (1, None)


GROUP = {"robots": ["r1"], "kind": "missing"}
DRAG, TOW, LAG, SLOPE = (
    {"effect": name, "indistinguishable_from": alike}
    for name, alike in (("drag", ["slope"]), ("tow", []), ("lag", []), ("slope", ["drag"]))
)


@pytest.mark.parametrize(
    ("hidden", "effects", "kind", "shared", "right"),
    [
        (["drag"], [DRAG], "missing", set(), True),
        (["slope"], [DRAG], "missing", set(), True),
        (["drag", "tow"], [DRAG, TOW], "missing", set(), True),
        (["drag"], [DRAG, TOW], "missing", set(), False),
        (["drag"], [DRAG, TOW], "missing", {"tow"}, True),
        (["drag", "tow"], [DRAG], "missing", set(), False),
        (["drag", "tow"], [DRAG, LAG], "missing", set(), False),
        (["lag", "tow"], [DRAG, LAG], "missing", set(), False),
        (["drag", "slope"], [DRAG, TOW], "missing", set(), False),  # one name stands for either, tow for neither
        (["drag", "slope"], [DRAG, SLOPE], "missing", set(), True),
        (["drag", "tow"], [DRAG, SLOPE], "missing", set(), False),  # two names for one of them
        (["lag"], [DRAG], "missing", set(), False),
        (["drag"], [DRAG], "unexplained", set(), False),
        ([], [], "nothing", set(), True),
        ([], [DRAG], "missing", set(), False),
        ([], [DRAG], "missing", {"slope"}, True),
        ([], [], "unexplained", set(), False),
    ],
)
def test_a_robot_is_right_where_all_that_is_hidden_is_named_and_nothing_else(
    hidden: list[str], effects: list[dict[str, Any]], kind: str, shared: set[str], right: bool
) -> None:
    group = {**GROUP, "kind": kind, "effects": effects}
    document = {"robots": [{"robot": "r0", "found": None}, {"robot": "r1", "found": []}]}
    row = _robot("r1", {name: {} for name in hidden}, group, document, shared)
    assert row["right"] is right
    assert (row["hidden"], row["found"], row["kind"]) == (hidden, [item["effect"] for item in effects], kind)


def test_numbers_of_what_was_found_are_told_in_their_stated_deviations() -> None:
    numbers = {"mass": {"value": 1.5, "std": 0.25}, "size": {"value": 1.0, "std": 0.0}}
    found = [{"effect": "tow", "parameters": numbers}, {"effect": "drag", "parameters": numbers}]
    assert _deviations({"tow": {"mass": 1.0, "size": 2.0}}, found) == {"tow.mass": 2.0}


def test_a_row_of_robots_that_meet() -> None:
    """Three drives of two robots, a minute each."""

    def driven(**changes: Any) -> dict[str, Any]:
        usual = {
            "seed": 1, "load": "none", "moving": [], "solid": [], "into_standing": 0, "both_standing": 0,
            "goals": [1, 2], "standing_share": 0.25, "stuck": [], "fastest_driven": 1.5,
        }  # fmt: skip
        return usual | changes

    drives = [
        driven(moving=["r1 r2", "r2 r1"], into_standing=1, both_standing=2, goals=[0, 0], standing_share=0.75),
        driven(seed=2, solid=["r1 wall"], both_standing=1, stuck=[{"face": True}, {"face": False}]),
        driven(seed=3, load="box", moving=["r1 r2"], stuck=[{"face": True}], goals=[4, 0], fastest_driven=1.9),
    ]
    row = meeting._row(2, "guard", drives, 60.0)
    assert row == {
        "robots": 2, "guard": "guard", "drives": 3, "drives_in_which_a_moving_car_touched_another": 2,
        "share_95": clopper_pearson_interval(2, 3), "contacts_in_which_a_car_moved": 3,
        "of_them_with_a_standing_car": 1, "contacts_of_standing_cars": 3, "moved_into_what_is_at_rest": 1,
        "which": [
            "seed 1, load none: r1 r2", "seed 1, load none: r2 r1", "seed 2, load none: r1 wall",
            "seed 3, load box: r1 r2",
        ],
        "goals_a_minute_and_robot": pytest.approx(7.0 / 6.0), "robots_without_a_goal": 3,
        "share_of_time_standing": pytest.approx(1.25 / 3.0), "stuck_pairs": 3, "stuck_face_to_face": 2,
        "fastest_driven": 1.9,
    }  # fmt: skip


def test_what_the_filter_changed_in_an_episode_is_all_that_is_not_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    statuses = ["passed"] * 4 + ["corrected"] * 3 + ["relaxed"] * 2 + ["fallback"] + ["disabled"] * 5
    ticks = [
        SimpleNamespace(verdict=SimpleNamespace(status=status, h_now=0.5 - 0.01 * k))
        for k, status in enumerate(statuses)
    ]
    robot = SimpleNamespace(collisions=[1, 2], goals_reached=3, trajectory_hash="abc")
    monkeypatch.setattr(safety, "CarRobot", lambda *_: robot)
    monkeypatch.setattr(safety, "drive", lambda _robot, _nodes, count: ticks[:count])
    found = safety.run_episode(safety.Episode("box", 1, True, 0.75, "car", settings_named("car")))
    assert (found.interventions, found.collisions, found.goals, found.ticks) == (6, 2, 3, 15)
    assert found.least_h == pytest.approx(0.5 - 0.14)
    assert found.statuses == {"passed": 4, "corrected": 3, "relaxed": 2, "fallback": 1, "disabled": 5}
