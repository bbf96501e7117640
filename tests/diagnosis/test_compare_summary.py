"""The sentences and the document of a comparison, and the error that they are about."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.compare.comparison import PREDICTORS, HorizonError, RunError
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
from safedpa.compare.where import Bin, Cell, Factor
from safedpa.records.run import Finding


def factor(variable: str, kind: str, explained: float, *errors: float) -> Factor:
    bins = (Bin(variable, "m/s", 0.0, 1.0, error, error / 0.5, 0.25, 3, {"x": 0.125}, None) for error in errors)
    return Factor(variable, "m/s", kind, explained, tuple(bins))


def run_error(name: str, **errors: float) -> RunError:
    values: dict[str, Any] = dict.fromkeys(RunError.__dataclass_fields__, 0.0)
    values |= {"name": name, "per_state": errors, "no_change": dict.fromkeys(errors, 1.0)}
    return RunError(**values)


def errors_of(*values: float) -> dict[str, RolloutError]:
    return {
        name: RolloutError(value, np.array([value, 2.0 * value]), np.array([0.5, 4.0]))
        for name, value in zip(PREDICTORS, values, strict=True)
    }


def comparison(**changes: Any) -> Any:
    variables = tuple(SimpleNamespace(name=name, unit="m") for name in ("x", "y"))
    system = SimpleNamespace(name="cart", state_names=("x", "y"), state=variables)
    windows = type("Windows", (), {"horizon": 1.0, "system": system, "__len__": lambda _: 60})()
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


def test_the_document_holds_everything_that_was_found() -> None:
    found = comparison()
    document = as_json(found)
    assert {key: document[key] for key in ("format", "robot", "effects", "parameters", "horizon", "windows")} == {
        "format": 1, "robot": "cart", "effects": ["drag", "tow"], "parameters": {"base.a": 1.0, "drag.c": 2.0},
        "horizon": 1.0, "windows": 60,
    }  # fmt: skip
    sentences = (where_sentence, state_sentence, naive_sentence, run_sentence)
    assert document["summary"] == [sentence(found) for sentence in sentences]
    assert (document["error"], document["per_state"]) == (0.5, {"x": 0.5, "y": 1.0})
    assert document["scale"] == {"x": 0.5, "y": 4.0}

    def row(value: float) -> dict[str, Any]:
        return {"error": value, "per_state": {"x": value, "y": 2 * value}, "rms": {"x": value / 2, "y": 8 * value}}

    assert document["naive"] == {"no_change": row(1.0), "constant_velocity": row(2.0)}
    assert document["horizons"] == [
        {"seconds": 0.5, "model": row(0.25), "no_change": row(0.75), "constant_velocity": row(1.5)},
        {"seconds": 1.0, "model": row(0.5), "no_change": row(1.0), "constant_velocity": row(2.0)},
    ]
    assert [(item["variable"], item["error"]) for item in document["where"]] == [
        ("x", 3.0), ("speed", 2.0), ("u", 1.5), ("u", 1.0), ("speed", 0.75), ("u", 0.25),
    ]  # fmt: skip
    assert [item.error for item in worst_bins(found)] == [item["error"] for item in document["where"]]
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
    quality = [(item["run"], item["kind"], item["count"]) for item in document["data_quality"]]
    assert quality == [("a", "gap", 2), ("c", "jump", 3)]


@pytest.mark.parametrize(
    ("explained", "named"),
    [((0.5, 0.25, 0.125), "speed"), ((0.5, 0.4, 0.125), "speed"), ((0.4, 0.5, 0.125), "u"),
     ((0.25, 0.5, 0.125), "u"), ((0.25, 0.25, 0.4), "speed"), ((0.2, 0.1, 0.4), "x"),
     ((-0.5, -0.75, 0.06), "x"), ((-0.5, -0.75, 0.04), "speed")],
)  # fmt: skip
def test_a_position_is_decisive_only_if_it_explains_half_as_much_again_and_0_05(
    explained: tuple[float, ...], named: str
) -> None:
    kinds = (("speed", "state"), ("u", "action"), ("x", "place"))
    made = [factor(*kind, share, 1.0) for kind, share in zip(kinds, explained, strict=True)]
    assert decisive(comparison(factors=tuple(sorted(made, key=lambda item: -item.explained)))).variable == named


def test_the_sentences_state_shares_sides_and_sizes() -> None:
    """The state y is off by 1.0 times 4 m; its median of -0.5 m is less than 0.3 of that."""
    share = "its error there is 2.00, 4.0 times the average of 0.50 (25 % of the squared error in 5 % of the windows)"
    assert share in where_sentence(comparison())
    said = state_sentence(comparison())
    assert said.startswith("The state predicted worst is y: off by 4 m after 1 s (to either side), 1.00 times")
    biased = state_sentence(comparison(errors=np.array([[0.0, -1.0], [0.0, -1.5], [0.0, -2.0]])))
    assert "(in the median 1.5 m too low)" in biased


@pytest.mark.parametrize(
    ("errors", "verdict"),
    [((0.5, 1.0, 2.0), "better than both"), ((1.5, 1.0, 2.0), "better than one of them only"),
     ((1.5, 2.0, 1.0), "better than one of them only"), ((3.0, 1.0, 2.0), "worse than both")],
)  # fmt: skip
def test_the_model_is_compared_with_predictors_without_physics(errors: tuple[float, ...], verdict: str) -> None:
    found = comparison(horizons=(HorizonError(0.5, errors_of(9.0, 9.0, 9.0)), HorizonError(1.0, errors_of(*errors))))
    said = naive_sentence(found)
    model, still, steady = errors
    assert f"error is {model:.2f}; assuming no change gives {still:.2f}, constant velocity {steady:.2f}" in said
    assert said.endswith(f": {verdict}.")


@pytest.mark.parametrize(
    ("runs", "odd", "lost"),
    [
        ({"a": 0.25, "b": 0.25, "c": 2.0}, "X is far worse in c than elsewhere: 2.00 where 0.25 is usual",
         "x in c (2.00)"),
        ({"a": 0.75, "b": 0.25, "c": 0.25}, "X is far worse in a than elsewhere: 0.75 where 0.25 is usual", ""),
        ({"a": 1.5, "b": 0.75, "c": 1.25}, "", "x in a (1.50), x in c (1.25)"),
        ({"a": 2.0, "b": 2.0}, "", ""), ({"a": 0.25, "b": 0.5}, "", ""), ({"a": 2.0}, "", ""), ({}, "", ""),
    ],
)  # fmt: skip
def test_a_run_that_stands_out_or_loses_to_no_change_is_named(runs: dict[str, float], odd: str, lost: str) -> None:
    said = run_sentence(comparison(runs=tuple(run_error(name, x=error) for name, error in runs.items())))
    text = "; ".join(part for part in (odd, f"worse than assuming no change: {lost}" if lost else "") if part)
    assert said == (text[0].upper() + text[1:] + "." if text else "")


@pytest.mark.parametrize("runs", [(run_error("a"), run_error("b")), (run_error("a", x=2.0, y=0.25),)])
def test_no_sentence_is_made_about_runs_without_change_or_about_a_single_run(runs: Any) -> None:
    assert run_sentence(comparison(runs=runs)) == ""


@pytest.mark.parametrize(
    ("after", "told"),
    [((0.25, 0.25), ""), ((0.26, 0.25), ""), ((0.27, 0.25), "x in a (0.25 to 0.27)"),
     ((0.3, 0.5), "x in b (0.25 to 0.5), x in a (0.25 to 0.3)")],
)  # fmt: skip
def test_states_that_get_worse_are_named_most_first(after: tuple[float, float], told: str) -> None:
    before = comparison(runs=(run_error("a", x=0.25), run_error("b", x=0.25)))
    later = comparison(runs=tuple(run_error(name, x=x) for name, x in zip("ab", after, strict=True)))
    said = worse_sentence(before, later)
    assert said.endswith(f"what gets worse: {told}." if told else "no state gets worse in any run.")
