"""Held-out errors: a window is predicted by numbers that were fitted without it; errors by run, state and fold."""

import math
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from safedpa.diagnosis.fit import cross_validation as held
from safedpa.diagnosis.fit import least_squares as fitting
from safedpa.diagnosis.fit.cross_validation import Heldout, HeldoutError, error_with, heldout_of
from safedpa.diagnosis.fit.least_squares import Fit, objectives, regularized_inverse
from safedpa.diagnosis.fit.multiple_shooting import VariableProjection
from safedpa.diagnosis.fit.trial import standardized_gains
from safedpa.diagnosis.search import search_state
from safedpa.diagnosis.search.search_state import SearchState, accept_trial
from safedpa.dynamics import Setting, load_model
from safedpa.effects import effect
from safedpa.records.run import Run, Stretch
from safedpa.robots.pendulum.system import PENDULUM

NAN = math.nan


def swinging(name: str, seconds: float, seed: int, period: float = 0.1) -> Run:
    count = round(seconds / period) + 1
    states = np.random.default_rng(seed).normal(scale=0.3, size=(count, 2))  # the short way round is unique
    return Run(name, PENDULUM, period * np.arange(count), states, np.zeros((count, 1)), (Stretch(0, count),))


def three_runs() -> list[Run]:
    return [swinging(str(number), 3.0, number) for number in range(3)]


@pytest.mark.parametrize(("seconds", "every"), [(10.0, 1), (120.0, 1), (240.0, 2), (600.0, 5)])
def test_windows_start_every_0_1_s_or_further_apart_in_long_logs(seconds: float, every: int) -> None:
    """There are 1200 windows at most: of ten minutes one every half second."""
    found = heldout_of([swinging("one", seconds, 1)], 1.0)
    assert found.windows.start.tolist() == list(range(0, round(10.0 * seconds) - 9, every))
    assert set(found.fold.tolist()) == set(range(6))


def fitted_without(**values: float) -> Any:
    """A fit whose number without fold 0 is ``fold_0`` and so on."""
    found = {int(name.partition("_")[2]): np.array([value]) for name, value in values.items()}
    return SimpleNamespace(model=9.0, paths=("p",), without=lambda shooting: found)


@pytest.fixture
def predicting(monkeypatch: pytest.MonkeyPatch) -> None:
    """A model is its number; it predicts the angle that number times 0.01 and the rate that number times 0.02 off."""

    def rollout_at(model: float, windows: Any, rows: Any) -> list[Any]:
        assert [own.tolist() for own in rows] == [windows.end.tolist()]
        return [windows.states[windows.end] + model * np.array([0.01, 0.02])]

    monkeypatch.setattr(held, "rollout_at", rollout_at)
    monkeypatch.setattr(held, "with_values", lambda model, values: values["p"])


@pytest.mark.usefixtures("predicting")
def test_each_run_is_predicted_with_parameters_fitted_without_it() -> None:
    heldout = heldout_of(three_runs(), 0.5, folds=3)
    found = error_with(fitted_without(fold_0=1.0, fold_1=2.0), None, heldout)  # type: ignore[arg-type]
    offsets = np.array([1.0, 2.0, 9.0])[heldout.windows.run]
    np.testing.assert_allclose(found.errors, offsets[:, None] * [0.01, 0.02])
    windows = heldout.windows
    scale = (windows.states[windows.end] - windows.states[windows.start]).std(axis=0)
    wanted = np.array([[1.0], [2.0], [9.0]]) * [0.01, 0.02] / scale
    np.testing.assert_allclose(found.by_run_and_state, wanted, rtol=1e-6)
    np.testing.assert_allclose(found.by_run, wanted.mean(axis=1), rtol=1e-6)
    np.testing.assert_allclose(found.by_fold, found.by_run)
    retained = np.sort(offsets)[: len(offsets) - len(offsets) // 20]
    per_state = np.sqrt((retained**2).mean()) * np.array([0.01, 0.02]) / scale
    np.testing.assert_allclose(found.per_state, per_state, rtol=1e-6)
    assert found.value == pytest.approx(per_state.mean(), rel=1e-6)
    assert found.standard_error == pytest.approx(found.by_fold.std(ddof=1) / np.sqrt(3.0))


@pytest.mark.usefixtures("predicting")
def test_a_prediction_that_diverged_makes_the_error_of_its_run_infinite() -> None:
    """It is not replaced by the prediction of the model that knows the run."""
    heldout = heldout_of(three_runs(), 0.5, folds=3)
    diverging = fitted_without(fold_0=NAN, fold_1=2.0, fold_2=2.0)
    found = error_with(diverging, None, heldout)  # type: ignore[arg-type]
    assert np.isnan(found.errors).all(axis=1).tolist() == (heldout.windows.run == 0).tolist()
    assert found.by_run[0] == found.value == np.inf
    assert np.isfinite(found.by_run[1:]).all()


@pytest.mark.usefixtures("predicting")
def test_runs_and_folds_without_windows_have_no_error() -> None:
    runs = [swinging("long", 3.0, 1), swinging("short", 0.2, 2), swinging("other", 3.0, 3)]
    windows = heldout_of(runs, 0.5, folds=3).windows
    heldout = Heldout(windows, np.where(windows.run == 0, 0, 3))
    found = error_with(fitted_without(fold_0=1.0, fold_1=5.0, fold_3=3.0), None, heldout)  # type: ignore[arg-type]
    assert np.isnan(found.by_run).tolist() == [False, True, False]
    assert np.isnan(found.by_run_and_state).tolist() == [[False] * 2, [True] * 2, [False] * 2]
    assert np.isnan(found.by_fold).tolist() == [False, True, True, False]
    assert found.by_run[2] == pytest.approx(3.0 * found.by_run[0])
    assert found.standard_error == pytest.approx(abs(found.by_fold[3] - found.by_fold[0]) / 2.0)
    single = Heldout(heldout_of([runs[0]], 0.5).windows, np.zeros(26, dtype=np.int64))
    one = error_with(fitted_without(fold_0=1.0), None, single)  # type: ignore[arg-type]
    assert (one.by_fold, one.standard_error) == (pytest.approx(one.by_run), 0.0)


@pytest.mark.parametrize(
    "folds", [(1.0, 2.0, 3.0), (1.0, NAN, 3.0), (0.2, 0.6), (0.0, 0.0, 0.0, 4.0), (2.0,) * 6, (4.0,), (NAN, 4.0), ()]
)
def test_the_standard_error_is_that_of_the_mean_over_the_folds(folds: tuple[float, ...]) -> None:
    none, known = np.zeros(0), [fold for fold in folds if not math.isnan(fold)]
    wanted = float(stats.sem(known)) if len(known) > 1 else 0.0
    assert HeldoutError(0.0, none, none, none, np.array(folds), none).standard_error == pytest.approx(wanted)


def test_an_accepted_trial_is_fitted_to_the_end_around_its_own_model(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitting, "fit", lambda *arguments: ("fitted", *arguments))
    monkeypatch.setattr(search_state, "trial_of", lambda *arguments: ("trial", *arguments))
    monkeypatch.setattr(search_state, "error_with", lambda *arguments: ("error", *arguments))
    windows = SimpleNamespace(around=lambda model: f"windows around {model}")
    nothing: Any = None
    search: Any = SearchState(windows, nothing, nothing, nothing, nothing, "held out", added=["drag"])  # type: ignore[arg-type]
    own = SimpleNamespace(model="the model with lag", paths=("drag.c", "lag.t"), scale="scale")
    accept_trial(search, SimpleNamespace(effects=("drag", "lag"), fit=own))  # type: ignore[arg-type]
    around = "windows around the model with lag"
    fitted = ("fitted", "the model with lag", ("drag.c", "lag.t"), around, "scale")
    assert (search.added, search.shooting) == (["drag", "lag"], around)
    assert search.current == ("trial", fitted, around, (), None)
    assert search.error == ("error", fitted, around, "held out")


WINDOWS, FOLDS = 12, 3
PATHS = ("viscous_drag.coefficient", "understeer.gradient")


@pytest.fixture
def made() -> Any:
    """made(free, folds) -> (fit, shooting): at random, with slopes so large that no prior counts."""

    def make(free: tuple[bool, bool] = (True, True), folds: int = FOLDS) -> tuple[Fit, Any]:
        random = np.random.default_rng(5)
        model = load_model("car").with_effect(effect("car", "viscous_drag"), {"coefficient": Setting(0.5)})
        model = model.with_effect(effect("car", "understeer"), {"gradient": Setting(0.03)})
        columns = 1e3 * random.standard_normal((WINDOWS, 4, 2))
        residual = random.standard_normal((WINDOWS, 4))
        nothing = np.zeros(0)
        fit = Fit(model, PATHS, -1.0, np.array([2.0, 0.5]), residual, columns, nothing, np.array(free),
                  (nothing, nothing))  # fmt: skip
        shooting = SimpleNamespace(
            fold=np.arange(WINDOWS) % folds, windows=range(WINDOWS),
            squares=lambda own: (own.reshape(WINDOWS, 2, 2) ** 2).sum(axis=1),
        )  # fmt: skip
        return fit, shooting

    return make


def least_squares(fit: Fit, shooting: Any, fold: int, free: tuple[bool, bool]) -> Any:
    """The numbers without the windows of one fold."""
    rest, moved = shooting.fold != fold, np.zeros(2)
    slopes = fit.columns[rest].reshape(-1, 2)[:, list(free)]
    moved[list(free)] = np.linalg.lstsq(slopes, -fit.residual[rest].reshape(-1), rcond=None)[0]
    return np.array([0.5, 0.03]) + moved


@pytest.mark.parametrize("free", [(True, True), (True, False), (False, True), (False, False)])
def test_parameters_without_a_fold_are_the_least_squares_of_the_other_folds(made: Any, free: tuple[bool, bool]) -> None:
    fit, shooting = made(free)
    found = fit.without(shooting)
    assert sorted(found) == list(range(FOLDS))
    for fold, values in found.items():
        assert values == pytest.approx(least_squares(fit, shooting, fold, free), rel=1e-6, abs=1e-9)
    assert [np.abs(found[0] - found[1])[number] > 1e-6 for number in range(2)] == list(free)
    fit, shooting = made(free, folds=1)
    assert {fold: values.tolist() for fold, values in fit.without(shooting).items()} == {0: [0.5, 0.03]}


def test_a_held_out_square_is_that_of_a_fit_without_the_window(made: Any) -> None:
    fit, shooting = made()
    wanted = np.empty((WINDOWS, 2))
    for window in range(WINDOWS):
        values = least_squares(fit, shooting, window % FOLDS, (True, True))
        left = fit.residual[window] + fit.columns[window] @ (values - np.array([0.5, 0.03]))
        wanted[window] = ((left.reshape(2, 2) * np.array([2.0, 0.5])) ** 2).sum(axis=0)  # in the states' units
    assert fit.heldout_squares(shooting) == pytest.approx(wanted, rel=1e-5)


def test_the_objective_is_the_mean_logarithm_of_the_root_mean_square_of_each_state() -> None:
    """Of 30 numbers with a mean square of 4, and 10 with one of 9: (30 log 2 + 10 log 3) / 40."""
    squares = np.array([[120.0, 30.0], [90.0, 10.0]])  # (states, models)
    elimination = SimpleNamespace(products=lambda own: own, squares=lambda own, _: own)
    shooting: Any = SimpleNamespace(elimination=elimination, size=np.array([30.0, 10.0]))
    found = objectives(squares, shooting, np.ones(2))
    assert found == pytest.approx([(30.0 * np.log(2.0) + 10.0 * np.log(3.0)) / 40.0, 0.0])


@pytest.mark.parametrize("sizes", [(1.0, 1.0), (1e-3, 1e3), (100.0, 7.0)])
def test_the_regularized_inverse_does_not_depend_on_units(sizes: tuple[float, float]) -> None:
    """Of [[2, 1], [1, 3]] it is [[3, -1], [-1, 2]] / 5; in other units each entry is divided by both."""
    outer = np.outer(sizes, sizes)
    found = regularized_inverse(np.array([[2.0, 1.0], [1.0, 3.0]]) * outer)
    np.testing.assert_allclose(found, np.array([[0.6, -0.2], [-0.2, 0.4]]) / outer, rtol=1e-6)


@pytest.mark.parametrize("scale", [(1.0, 1.0), (0.5, 4.0)])
@pytest.mark.parametrize("counts", [1.0, 0.25])
def test_reduced_residuals_are_what_least_squares_leaves_in_each_window(scale: tuple[float, float], counts: float):
    """Rows count by the root of their counts over the scale of their state."""
    random, scales = np.random.default_rng(1), np.array(scale)
    weights = np.ones((3, 5, 2))
    weights[1, 2:] = counts
    tangent, columns = random.normal(size=(3, 5, 2, 2)), random.normal(size=(3, 5, 2, 4))
    made = VariableProjection(weights, tangent)
    reduced = made.reduced(columns, scales)
    left = np.zeros((3, 5, 2, 4))
    for window in range(3):
        root = (np.sqrt(weights[window]) / scales).reshape(-1, 1)
        basis, wanted = root * tangent[window].reshape(-1, 2), root * columns[window].reshape(-1, 4)
        rest = wanted - basis @ np.linalg.lstsq(basis, wanted, rcond=None)[0]
        np.testing.assert_allclose(reduced[window], rest, atol=1e-6)
        left[window] = rest.reshape(5, 2, 4)
    squares = made.squares(made.products(columns.transpose(3, 0, 1, 2)), scales)
    np.testing.assert_allclose(squares, (left**2).sum(axis=(0, 1)) * scales[:, None] ** 2, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_the_gain_of_blocks_of_windows_is_the_deviate_of_students_law(seed: int) -> None:
    """As far out in the normal law as t is in Student's, to a part in fifty."""
    size, blocks = 10, 12
    differences = np.random.default_rng(seed).normal(3.0, 4.0, size * blocks)
    shooting: Any = SimpleNamespace(first_of_block=np.arange(0, size * blocks, size), by_block=np.arange(size * blocks))
    (found,) = standardized_gains(differences[None], shooting)
    t = stats.ttest_1samp(differences.reshape(blocks, size).sum(axis=1), 0.0)
    assert found == pytest.approx(stats.norm.isf(t.pvalue / 2.0) * np.sign(t.statistic), rel=0.02)
    assert standardized_gains(-differences[None], shooting)[0] == pytest.approx(-found)


def test_a_copy_of_a_search_shares_nothing_that_it_changes() -> None:
    nothing: Any = None
    search = SearchState(nothing, nothing, nothing, nothing, nothing, nothing, [], rivals={"drag": ["lag"]})
    copied = search.copy()
    for name in [item.name for item in fields(search) if isinstance(getattr(search, item.name), list | dict)]:
        if name != "library":
            assert getattr(copied, name) is not getattr(search, name), name
    assert copied.rivals == {"drag": ["lag"]}


def test_a_search_that_begins_again_keeps_what_it_was_given() -> None:
    one: Any = SimpleNamespace(name="one")
    other: Any = SimpleNamespace(name="other")
    search = SearchState(other, other, other, one, one, one, [], given=one, first_shooting=one, raw=one, judge=one)
    again = search.restarted()
    for name in ("shooting", "current", "error", "first", "first_error", "heldout", "given", "raw", "judge"):
        assert getattr(again, name) is one, name
    assert again.added == []
