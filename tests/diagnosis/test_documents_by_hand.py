"""The sentences and the document of a comparison that is written down by hand, and which runs, rows and files count."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.compare.actuators import _starts
from safedpa.compare.bins import merged
from safedpa.compare.comparison import HorizonError, RunError
from safedpa.compare.rollout_error import RolloutError
from safedpa.compare.summary import (
    as_json,
    decisive,
    naive_sentence,
    run_sentence,
    state_sentence,
    where_sentence,
    worse_sentence,
    worst_bins,
)
from safedpa.compare.where import Bin, Cell, Factor, window_errors
from safedpa.compare.windows import check_runs
from safedpa.errors import SafedpaError
from safedpa.fleet.common import _only
from safedpa.fleet.outcome import Tried, outcome_of
from safedpa.fleet.robots import _grouped
from safedpa.records.run import Finding


def bin_of(variable: str, error: float, samples: int = 3, run: str | None = None) -> Bin:
    return Bin(variable, "m/s", 0.0, 1.0, error, error / 0.5, 0.25, samples, {"x": 0.125}, run)


def factor(variable: str, kind: str, explained: float, *errors: float) -> Factor:
    return Factor(variable, "m/s", kind, explained, tuple(bin_of(variable, error) for error in errors))


def run_error(name: str, **errors: float) -> RunError:
    values: dict[str, Any] = dict.fromkeys(RunError.__dataclass_fields__, 0.0)
    values |= {"name": name, "per_state": errors, "no_change": dict.fromkeys(errors, 1.0)}
    return RunError(**values)


def errors_of(*values: float) -> dict[str, RolloutError]:
    names = ("model", "no_change", "constant_velocity")
    return {
        name: RolloutError(value, np.array([value, 2.0 * value]), np.array([0.5, 4.0]))
        for name, value in zip(names, values, strict=True)
    }


def comparison(**changes: Any) -> Any:
    variables = tuple(SimpleNamespace(name=name, unit="m") for name in ("x", "y"))
    system = SimpleNamespace(name="cart", state_names=("x", "y"), state=variables)

    class Windows:
        horizon = 1.0

        def __len__(self) -> int:
            return 60

    windows: Any = Windows()
    windows.system = system
    horizons = (HorizonError(0.5, errors_of(0.25, 0.75, 1.5)), HorizonError(1.0, errors_of(0.5, 1.0, 2.0)))
    usual: dict[str, Any] = {
        "model": SimpleNamespace(
            effects=(SimpleNamespace(name="drag"), SimpleNamespace(name="tow")),
            settings={"base.a": SimpleNamespace(value=1.0), "drag.c": SimpleNamespace(value=2.0)},
        ),
        "windows": windows, "horizons": horizons, "horizon": 1.0, "error": horizons[-1].errors["model"],
        "errors": np.array([[0.1, -0.5], [0.2, -0.25], [0.3, -2.0]]),
        "factors": (factor("speed", "state", 0.5, 0.75, 2.0), factor("u", "action", 0.25, 1.0, 0.25, 1.5),
                    factor("x", "place", 0.125, 3.0)),
        "cells": (Cell(0.0, 1.0, 2.0, 3.0, 0.5, 0.25, 7), Cell(1.0, 2.0, 2.0, 3.0, np.inf, 0.75, 5)),
        "runs": (run_error("a", x=0.25, y=0.5), run_error("b", x=0.25, y=0.25), run_error("c", x=2.0, y=0.5)),
        "findings": (("a", Finding("gap", "a gap", 2)), ("c", Finding("jump", "a jump", 3))),
    }  # fmt: skip
    return SimpleNamespace(**usual | changes)


def test_the_document_has_everything_and_nothing_twice() -> None:
    found = comparison()
    document = as_json(found)
    assert {key: document[key] for key in ("format", "robot", "effects", "parameters", "horizon", "windows")} == {
        "format": 1, "robot": "cart", "effects": ["drag", "tow"], "parameters": {"base.a": 1.0, "drag.c": 2.0},
        "horizon": 1.0, "windows": 60,
    }  # fmt: skip
    assert document["summary"] == [
        where_sentence(found), state_sentence(found), naive_sentence(found), run_sentence(found)
    ]  # fmt: skip
    assert (document["error"], document["per_state"]) == (0.5, {"x": 0.5, "y": 1.0})
    assert document["scale"] == {"x": 0.5, "y": 4.0}

    def row(value: float) -> dict[str, Any]:
        return {
            "error": value, "per_state": {"x": value, "y": 2 * value}, "rms": {"x": 0.5 * value, "y": 8 * value}
        }  # fmt: skip

    assert document["naive"] == {"no_change": row(1.0), "constant_velocity": row(2.0)}
    assert document["horizons"] == [
        {"seconds": 0.5, "model": row(0.25), "no_change": row(0.75), "constant_velocity": row(1.5)},
        {"seconds": 1.0, "model": row(0.5), "no_change": row(1.0), "constant_velocity": row(2.0)},
    ]
    assert [(item["variable"], item["error"]) for item in document["where"]] == [
        ("x", 3.0), ("speed", 2.0), ("u", 1.5), ("u", 1.0), ("speed", 0.75), ("u", 0.25),
    ]  # fmt: skip
    assert document["where"][1] == {
        "variable": "speed", "unit": "m/s", "low": 0.0, "high": 1.0, "error": 2.0, "ratio": 4.0, "share": 0.25,
        "samples": 3, "bias": {"x": 0.125},
    }  # fmt: skip
    assert document["explained"] == {"speed": 0.5, "u": 0.25, "x": 0.125}
    assert document["place"] == [
        {"x_low": 0.0, "x_high": 1.0, "y_low": 2.0, "y_high": 3.0, "error": 0.5, "share": 0.25, "samples": 7},
        {"x_low": 1.0, "x_high": 2.0, "y_low": 2.0, "y_high": 3.0, "error": None, "share": 0.75, "samples": 5},
    ]
    assert [(item["name"], item["per_state"]) for item in document["runs"]] == [
        ("a", {"x": 0.25, "y": 0.5}), ("b", {"x": 0.25, "y": 0.25}), ("c", {"x": 2.0, "y": 0.5}),
    ]  # fmt: skip
    assert all(set(item) == set(RunError.__dataclass_fields__) for item in document["runs"])
    assert [(item["run"], item["kind"], item["count"]) for item in document["data_quality"]] == [
        ("a", "gap", 2), ("c", "jump", 3)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("explained", "named"),
    [((0.5, 0.25, 0.125), "speed"), ((0.5, 0.4, 0.125), "speed"), ((0.4, 0.5, 0.125), "u"),
     ((0.25, 0.5, 0.125), "u"), ((0.25, 0.25, 0.4), "speed"), ((0.2, 0.1, 0.4), "x"),
     ((-0.5, -0.75, 0.06), "x"), ((-0.5, -0.75, 0.04), "speed")],
)  # fmt: skip
def test_a_place_is_named_where_it_explains_clearly_more(explained: tuple[float, ...], named: str) -> None:
    kinds = (("speed", "state"), ("u", "action"), ("x", "place"))
    made = [factor(*kind, share, 1.0) for kind, share in zip(kinds, explained, strict=True)]
    found = comparison(factors=tuple(sorted(made, key=lambda item: -item.explained)))
    assert decisive(found).variable == named


def test_bins_of_every_variable_stand_in_the_order_of_their_errors() -> None:
    assert [item.error for item in worst_bins(comparison())] == [3.0, 2.0, 1.5, 1.0, 0.75, 0.25]


def test_where_it_fails_most_is_told_in_shares_of_errors_and_windows() -> None:
    said = where_sentence(comparison())
    assert (
        "its error there is 2.00, 4.0 times the average of 0.50 (25 % of the squared error in 5 % of the windows)"
        in said
    )


def test_the_state_that_is_predicted_worst_is_told_with_its_side() -> None:
    """Of y 1.0 times 4 m; its median is -0.5 m, less than 0.3 of that."""
    said = state_sentence(comparison())
    assert said.startswith("The state predicted worst is y: off by 4 m after 1 s (to either side), 1.00 times")
    biased = state_sentence(comparison(errors=np.array([[0.0, -1.0], [0.0, -1.5], [0.0, -2.0]])))
    assert "(in the median 1.5 m too low)" in biased


@pytest.mark.parametrize(
    ("errors", "verdict"),
    [((0.5, 1.0, 2.0), "better than both"), ((1.5, 1.0, 2.0), "better than one of them only"),
     ((1.5, 2.0, 1.0), "better than one of them only"), ((3.0, 1.0, 2.0), "worse than both")],
)  # fmt: skip
def test_the_model_beside_those_that_know_no_physics(errors: tuple[float, ...], verdict: str) -> None:
    found = comparison(horizons=(HorizonError(0.5, errors_of(9.0, 9.0, 9.0)), HorizonError(1.0, errors_of(*errors))))
    said = naive_sentence(found)
    assert said.endswith(f": {verdict}.")
    assert (
        f"error is {errors[0]:.2f}; assuming no change gives {errors[1]:.2f}, constant velocity {errors[2]:.2f}" in said
    )


@pytest.mark.parametrize(
    ("runs", "odd", "lost"),
    [
        ({"a": 0.25, "b": 0.25, "c": 2.0}, "X is far worse in c than elsewhere: 2.00 where 0.25 is usual",
         "x in c (2.00)"),
        ({"a": 0.75, "b": 0.25, "c": 0.25}, "X is far worse in a than elsewhere: 0.75 where 0.25 is usual", ""),
        ({"a": 1.5, "b": 0.75, "c": 1.25}, "", "x in a (1.50), x in c (1.25)"),
        ({"a": 2.0, "b": 2.0}, "", ""),
        ({"a": 0.25, "b": 0.5}, "", ""),
        ({"a": 2.0}, "", ""),
        ({}, "", ""),
    ],
)  # fmt: skip
def test_a_run_that_stands_out_is_named_and_where_no_change_would_be_better(
    runs: dict[str, float], odd: str, lost: str
) -> None:
    said = run_sentence(comparison(runs=tuple(run_error(name, x=error) for name, error in runs.items())))
    parts = [part for part in (odd, f"worse than assuming no change: {lost}" if lost else "") if part]
    text = "; ".join(parts)
    assert said == (text[0].upper() + text[1:] + "." if parts else "")


def test_runs_without_a_state_that_moved_say_nothing() -> None:
    assert run_sentence(comparison(runs=(run_error("a"), run_error("b")))) == ""


def test_of_one_run_alone_nothing_is_said_whatever_its_states_do() -> None:
    """Two of its states are beside "no change", one worse and one better: there is no other run to tell it from."""
    assert run_sentence(comparison(runs=(run_error("a", x=2.0, y=0.25),))) == ""


@pytest.mark.parametrize(
    ("after", "told"),
    [((0.25, 0.25), ""), ((0.26, 0.25), ""), ((0.27, 0.25), "x in a (0.25 to 0.27)"),
     ((0.3, 0.5), "x in b (0.25 to 0.5), x in a (0.25 to 0.3)")],
)  # fmt: skip
def test_what_gets_worse_is_named_most_first(after: tuple[float, float], told: str) -> None:
    before = comparison(runs=(run_error("a", x=0.25), run_error("b", x=0.25)))
    later = comparison(runs=tuple(run_error(name, x=x) for name, x in zip("ab", after, strict=True)))
    said = worse_sentence(before, later)
    assert said.endswith(f"what gets worse: {told}." if told else "no state gets worse in any run.")


@pytest.mark.parametrize(
    ("errors", "scale", "found"),
    [
        ([[3.0, 8.0], [0.0, 2.0]], [1.0, 2.0], [np.sqrt(12.5), np.sqrt(0.5)]),
        ([[3.0, 8.0], [-4.0, 2.0]], [1.0, 0.0], [3.0, 4.0]),
        ([[3.0, 8.0]], [0.0, 0.0], [0.0]),
    ],
)
def test_the_error_of_a_window_is_the_root_of_its_mean_square(
    errors: list[list[float]], scale: list[float], found: list[float]
) -> None:
    np.testing.assert_allclose(window_errors(np.array(errors), np.array(scale)), found)


@pytest.mark.parametrize(
    ("name", "states", "actions", "same"),
    [("cart", ("x", "v"), ("u",), True), ("car", ("x", "v"), ("u",), False), ("cart", ("x", "w"), ("u",), False),
     ("cart", ("x", "v"), ("w",), False)],
)  # fmt: skip
def test_runs_are_of_one_robot_with_the_same_states_and_actions(
    name: str, states: tuple[str, ...], actions: tuple[str, ...], same: bool
) -> None:
    def run(*system: Any) -> Any:
        part = (np.arange(3.0), np.zeros((3, 2)), np.zeros((3, 1)))
        told = dict(zip(("name", "state_names", "action_names"), system, strict=True))
        return SimpleNamespace(
            name="a", system=SimpleNamespace(**told), stretches=(range(3),), parts=lambda: iter([part])
        )

    runs = [run("cart", ("x", "v"), ("u",)), run(name, states, actions)]
    if same:
        check_runs(runs)
    else:
        with pytest.raises(SafedpaError, match="compare them one at a time"):
            check_runs(runs)


@pytest.mark.parametrize("smallest", [1, 3, 4, 9])
def test_bins_that_hold_too_few_join_their_right_neighbour(smallest: int) -> None:
    """Of 3, 1, 2 and 3 values; what is left over at the end joins the last bin that is kept."""
    values = np.array([0.1, 0.2, 0.3, 1.5, 2.1, 2.2, 3.1, 3.2, 3.3])
    wanted = {1: [0, 1, 2, 3, 4], 3: [0, 1, 3, 4], 4: [0, 2, 4], 9: [0, 4]}[smallest]
    assert merged(values, np.arange(5.0), smallest).tolist() == wanted


def test_where_all_bins_together_hold_too_few_there_is_one() -> None:
    assert merged(np.array([0.5, 1.5]), np.arange(4.0), 5).tolist() == [0.0, 3.0]


@pytest.mark.parametrize("begins", [(0,), (0, 7), (0, 1, 30)])
@pytest.mark.parametrize("decay", [0.1, 0.9, 0.999])
def test_a_lag_is_felt_row_by_row_and_begins_anew_with_each_stretch(
    begins: tuple[int, ...], decay: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("safedpa.compare.actuators._begins", lambda _: np.array(begins))
    random = np.random.default_rng(2)
    column, decays = random.normal(size=40), decay ** random.uniform(0.5, 2.0, 40)
    felt = [0.0] * 40
    for row in range(40):
        if row in begins:
            felt[row] = column[row]
        else:
            felt[row] = decays[row - 1] * felt[row - 1] + (1.0 - decays[row - 1]) * column[row - 1]
    np.testing.assert_allclose(_starts(column, decays, None), felt, atol=1e-3)  # type: ignore[arg-type]


def candidate(effect: str, stage: int, decision: str, score: float, *alike: str) -> dict[str, Any]:
    numbers = {"c": {"value": 10.0 * stage + score, "std": 1.0, "unit": "1"}}
    return {
        "effect": effect, "stage": stage, "decision": decision, "score": score, "parameters": numbers,
        "indistinguishable_from": list(alike),
    }  # fmt: skip


def test_a_robots_outcome_by_hand() -> None:
    """Two effects as a pair and one alone were accepted; a base number was free; five were tried first."""
    value = {"value": 1.0, "std": 0.5, "unit": "1"}
    report = {
        "robot": "car", "added": ["a", "b", "d"], "conditions": [], "unexplained": None,
        "candidates": [
            candidate("a", 0, "rejected", 1.0), candidate("a + b", 0, "accepted", 5.0, "e", "a + f"),
            candidate("e", 0, "rejected", 4.0), candidate("c", 0, "rejected", 2.0), candidate("d", 0, "rejected", 3.0),
            candidate("d", 1, "accepted", 7.0), candidate("e", 1, "rejected", 6.0), candidate("c", 2, "rejected", 0.5),
        ],
        "parameters": {"a.c": {**value, "value": 2.0}, "b.c": {**value, "value": 3.0}, "d.c": value, "base.m": value},
        "stages": [{"heldout_error": 0.75}, {"heldout_error": 0.5}, {"heldout_error": 0.25}],
        "data_quality": [{"message": "x"}, {"message": "x"}, {"message": "y"}],
    }  # fmt: skip
    result = {"robot": "r1", "status": "missing", "reason": "", "unreadable_files": ["f", "g"]}
    found = outcome_of(result, report)
    assert (found.trials, found.findings, found.unread) == (5, 2, 2)
    assert (found.error_before, found.error_after) == (0.75, 0.25)
    assert found.free is not None
    assert list(found.free) == ["base.m"]
    assert [item.effect for item in found.found] == ["a", "b", "d"]
    assert [item.numbers["c"].value for item in found.found] == [2.0, 3.0, 1.0]
    assert [item.score for item in found.found] == [5.0, 5.0, 7.0]
    assert [item.equals for item in found.found] == [("e",), ("e",), ()]
    assert found.last is not None
    assert set(found.last) == {"c"}


def test_of_an_outcome_one_effect_alone() -> None:
    items = tuple(Tried(name, {}, 1.0, ()) for name in ("a", "b", "a"))
    outcome: Any = SimpleNamespace(name="r", status="missing", reason="so", found=items)
    assert [item.effect for item in _only(outcome, "a").found] == ["a", "a"]
    assert [item.effect for item in _only(outcome, "b").found] == ["b"]


@pytest.mark.parametrize(
    ("by", "groups", "left"),
    [
        ("folder", {"r1": ["r1/a.csv", "r1/deep/b.csv"], "r2": ["r2/a.csv"]}, ["c.csv"]),
        ("file", {"c": ["c.csv"], "r1_a": ["r1/a.csv"], "r1_deep_b": ["r1/deep/b.csv"], "r2_a": ["r2/a.csv"]}, []),
    ],
)
def test_recordings_are_those_of_their_folder_or_of_a_robot_each(
    by: Any, groups: dict[str, list[str]], left: list[str]
) -> None:
    base = Path("fleet")
    files = [base / name for name in ("c.csv", "r1/a.csv", "r1/deep/b.csv", "r2/a.csv")]
    found = _grouped(files, base, by)
    assert {item.name: [str(path.relative_to(base)) for path in item.files] for item in found.robots} == groups
    assert [str(path.relative_to(base)) for path, _ in found.left_out] == left


def test_the_same_name_with_another_ending_is_another_robot() -> None:
    found = _grouped([Path("f/a.csv"), Path("f/a.mcap")], Path("f"), "file")
    assert [item.name for item in found.robots] == ["a", "a.mcap"]


def test_files_alone_are_no_folders_of_robots() -> None:
    with pytest.raises(SafedpaError, match="got files only"):
        _grouped([Path("f/a.csv"), Path("f/b.csv")], Path("f"), "folder")
