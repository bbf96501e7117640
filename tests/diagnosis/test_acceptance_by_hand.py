"""What is held out is predicted without it, its error told by run, state and fold; and what accepting a trial does."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.fit import heldout as held
from safedpa.diagnosis.fit.heldout import Heldout, HeldoutError, error_with, heldout_of
from safedpa.diagnosis.search import acceptance
from safedpa.diagnosis.search.acceptance import accept
from safedpa.records.run import Run, Stretch
from safedpa.robots.pendulum.system import PENDULUM


def swinging(name: str, seconds: float, seed: int, period: float = 0.1) -> Run:
    count = round(seconds / period) + 1
    states = np.random.default_rng(seed).normal(scale=0.3, size=(count, 2))  # no way round is the shorter one
    return Run(name, PENDULUM, period * np.arange(count), states, np.zeros((count, 1)), (Stretch(0, count),))


@pytest.mark.parametrize(("seconds", "every"), [(10.0, 1), (120.0, 1), (240.0, 2), (600.0, 5)])
def test_windows_begin_every_tenth_of_a_second_and_farther_apart_in_long_logs(seconds: float, every: int) -> None:
    """1200 windows of all: of ten minutes one every half second."""
    found = heldout_of([swinging("one", seconds, 1)], 1.0)
    assert found.windows.start.tolist() == list(range(0, round(10.0 * seconds) - 9, every))
    assert set(found.fold.tolist()) == set(range(6))


def fitted_without(**values: float) -> Any:
    """A fit whose number without fold 0 is ``fold_0`` and so on."""
    found = {int(name.partition("_")[2]): np.array([value]) for name, value in values.items()}
    return SimpleNamespace(model=9.0, paths=("p",), without=lambda shooting: found)


@pytest.fixture
def predicting(monkeypatch: pytest.MonkeyPatch) -> None:
    """A model is its number, and predicts the measured angle and that number more, and the rate and twice as much."""

    def rollout_at(model: float, windows: Any, rows: Any) -> list[Any]:
        assert [own.tolist() for own in rows] == [windows.end.tolist()]
        return [windows.states[windows.end] + model * np.array([0.01, 0.02])]

    monkeypatch.setattr(held, "rollout_at", rollout_at)
    monkeypatch.setattr(held, "moved", lambda model, values: values["p"])


@pytest.mark.usefixtures("predicting")
def test_each_run_is_predicted_by_the_numbers_found_without_it() -> None:
    runs = [swinging(str(number), 3.0, number) for number in range(3)]
    heldout = heldout_of(runs, 0.5, folds=3)
    found = error_with(fitted_without(fold_0=1.0, fold_1=2.0), None, heldout)  # type: ignore[arg-type]
    offsets = np.array([1.0, 2.0, 9.0])[heldout.windows.run]
    np.testing.assert_allclose(found.errors, offsets[:, None] * [0.01, 0.02])
    windows = heldout.windows
    scale = (windows.states[windows.end] - windows.states[windows.start]).std(axis=0)
    wanted = np.array([[1.0], [2.0], [9.0]]) * [0.01, 0.02] / scale
    np.testing.assert_allclose(found.by_run_and_state, wanted, rtol=1e-6)
    np.testing.assert_allclose(found.by_run, wanted.mean(axis=1), rtol=1e-6)
    np.testing.assert_allclose(found.by_fold, found.by_run)
    kept = np.sort(offsets)[: len(offsets) - len(offsets) // 20]
    per_state = np.sqrt((kept**2).mean()) * np.array([0.01, 0.02]) / scale
    np.testing.assert_allclose(found.per_state, per_state, rtol=1e-6)
    assert found.value == pytest.approx(per_state.mean(), rel=1e-6)
    assert found.standard_error == pytest.approx(found.by_fold.std(ddof=1) / np.sqrt(3.0))


@pytest.mark.usefixtures("predicting")
def test_of_one_fold_there_is_one_error() -> None:
    heldout = Heldout(heldout_of([swinging("one", 3.0, 1)], 0.5).windows, np.zeros(26, dtype=np.int64))
    found = error_with(fitted_without(fold_0=1.0), None, heldout)  # type: ignore[arg-type]
    assert found.by_fold == pytest.approx(found.by_run)
    assert found.standard_error == 0.0


@pytest.mark.usefixtures("predicting")
def test_a_prediction_that_came_to_nothing_is_not_taken_from_the_model_that_knows_the_run() -> None:
    """Not a number in every state, or in one: the run's own error is infinite, whatever all runs together fit."""
    runs = [swinging(str(number), 3.0, number) for number in range(3)]
    heldout = heldout_of(runs, 0.5, folds=3)
    diverging = fitted_without(fold_0=float("nan"), fold_1=2.0, fold_2=2.0)
    found = error_with(diverging, None, heldout)  # type: ignore[arg-type]
    assert np.isnan(found.errors).all(axis=1).tolist() == (heldout.windows.run == 0).tolist()
    assert found.by_run[0] == found.value == np.inf
    assert np.isfinite(found.by_run[1:]).all()


@pytest.mark.usefixtures("predicting")
def test_a_run_without_windows_has_no_error_and_folds_without_windows_none() -> None:
    runs = [swinging("long", 3.0, 1), swinging("short", 0.2, 2), swinging("other", 3.0, 3)]
    windows = heldout_of(runs, 0.5, folds=3).windows
    heldout = Heldout(windows, np.where(windows.run == 0, 0, 3))
    found = error_with(fitted_without(fold_0=1.0, fold_1=5.0, fold_3=3.0), None, heldout)  # type: ignore[arg-type]
    assert np.isnan(found.by_run).tolist() == [False, True, False]
    assert np.isnan(found.by_run_and_state).tolist() == [[False] * 2, [True] * 2, [False] * 2]
    assert np.isnan(found.by_fold).tolist() == [False, True, True, False]
    assert found.by_run[2] == pytest.approx(3.0 * found.by_run[0])
    assert found.standard_error == pytest.approx(abs(found.by_fold[3] - found.by_fold[0]) / 2.0)


def test_of_two_folds_the_error_of_the_mean_is_half_their_distance_and_of_one_unknown() -> None:
    def of(*by_fold: float) -> float:
        own = np.array(by_fold)
        return HeldoutError(0.4, own, own, own, own, own).standard_error

    assert of(0.2, 0.6) == pytest.approx(0.2)
    assert of(0.2) == of() == of(float("nan"), 0.3) == 0.0


def test_what_is_accepted_is_fitted_to_the_end_and_its_error_counts_from_then_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said: list[Any] = []

    def fit(*arguments: Any) -> str:
        said.append(arguments)
        return "fitted to the end"

    monkeypatch.setattr(acceptance, "fit", fit)
    monkeypatch.setattr(acceptance, "trial_of", lambda *arguments: ("trial", arguments))
    monkeypatch.setattr(acceptance, "error_with", lambda *arguments: ("error", arguments))
    windows = SimpleNamespace(around=lambda model: f"windows around {model}")
    search: Any = SimpleNamespace(added=["drag"], shooting=windows, current=None, error=None)
    own = SimpleNamespace(model="the model with lag", paths=("drag.c", "lag.t"), scale="scale")
    best: Any = SimpleNamespace(effects=("drag", "lag"), fit=own)
    heldout: Any = "held out"
    accept(search, best, heldout)
    around = "windows around the model with lag"
    assert said == [("the model with lag", ("drag.c", "lag.t"), around, "scale")]
    assert search.added == ["drag", "lag"], "each once"
    assert search.shooting == around
    assert search.current == ("trial", ("fitted to the end", around, (), None))
    assert search.error == ("error", ("fitted to the end", around, "held out"))
