"""Numbers fitted without a fold, to first order: where residuals are lines, least squares of the rest tell them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.fit.least_squares import Fit, objectives
from safedpa.diagnosis.fit.shooting import _counts, _robust, folds_of

WINDOWS, FOLDS = 12, 3
PATHS = ("viscous_drag.coefficient", "understeer.gradient")


@pytest.fixture
def made(plain: Any, with_effect: Any) -> Any:
    """made(free, folds) -> (fit, shooting): at random, with slopes so large that no prior counts beside them."""

    def make(free: tuple[bool, bool] = (True, True), folds: int = FOLDS) -> tuple[Fit, Any]:
        random = np.random.default_rng(5)
        model = with_effect(with_effect(plain, "viscous_drag", coefficient=0.5), "understeer", gradient=0.03)
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
    """What the numbers become where the windows of one fold are not there."""
    rest = shooting.fold != fold
    moved = np.zeros(2)
    slopes = fit.columns[rest].reshape(-1, 2)[:, list(free)]
    moved[list(free)] = np.linalg.lstsq(slopes, -fit.residual[rest].reshape(-1), rcond=None)[0]
    return np.array([0.5, 0.03]) + moved


@pytest.mark.parametrize("free", [(True, True), (True, False), (False, True), (False, False)])
def test_without_a_fold_the_numbers_are_those_of_the_other_folds(made: Any, free: tuple[bool, bool]) -> None:
    fit, shooting = made(free)
    found = fit.without(shooting)
    assert sorted(found) == list(range(FOLDS))
    for fold, values in found.items():
        assert values == pytest.approx(least_squares(fit, shooting, fold, free), rel=1e-6, abs=1e-9)
    apart = [np.abs(found[0] - found[1])[number] > 1e-6 for number in range(2)]
    assert apart == list(free), "what was left out shows, in what is free"


def test_of_one_fold_nothing_is_left_out(made: Any) -> None:
    fit, shooting = made(folds=1)
    assert {fold: values.tolist() for fold, values in fit.without(shooting).items()} == {0: [0.5, 0.03]}


def test_a_held_out_square_is_that_of_a_fit_that_did_not_see_the_window(made: Any) -> None:
    fit, shooting = made()
    wanted = np.empty((WINDOWS, 2))
    for window in range(WINDOWS):
        values = least_squares(fit, shooting, window % FOLDS, (True, True))
        left = fit.residual[window] + fit.columns[window] @ (values - np.array([0.5, 0.03]))
        wanted[window] = ((left.reshape(2, 2) * np.array([2.0, 0.5])) ** 2).sum(axis=0)  # in the states' units
    assert fit.heldout_squares(shooting) == pytest.approx(wanted, rel=1e-5)


def windows(*runs: tuple[int, float]) -> Any:
    """Of each run so many windows of 1 s, one after the other, the first at so many s by its clock."""
    many = sum(count for count, _ in runs)
    clock = np.concatenate([first + np.arange(count + 1) for count, first in runs])
    start = np.concatenate([np.arange(count) + sum(c + 1 for c, _ in runs[:at]) for at, (count, _) in enumerate(runs)])
    own = SimpleNamespace(
        names=tuple("abcdef"[: len(runs)]), run=np.repeat(np.arange(len(runs)), [count for count, _ in runs]),
        clock=clock, start=start, end=start + 1,
    )  # fmt: skip
    return type("Windows", (), {**vars(own), "__len__": lambda _: many})()


def test_three_runs_are_held_out_whole() -> None:
    assert folds_of(windows((3, 0.0), (2, 5.0), (4, 0.0)), 5).tolist() == [0] * 3 + [1] * 2 + [2] * 4
    assert folds_of(windows((1, 0.0), (1, 0.0), (1, 0.0), (2, 0.0)), 3).tolist() == [0, 1, 2, 0, 0]


def test_of_one_or_two_runs_stretches_of_time_are_held_out_in_each_of_them() -> None:
    """Ten seconds in five folds are two each; four seconds in two, two each, whatever the clock began with."""
    assert folds_of(windows((10, 0.0)), 5).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert folds_of(windows((10, 100.0), (4, 7.0)), 2).tolist() == [0] * 5 + [1] * 5 + [0, 0, 1, 1]
    assert folds_of(windows((4, 0.0), (10, 50.0)), 2).tolist() == [0, 0, 1, 1] + [0] * 5 + [1] * 5


def weights(pushes: dict[int, tuple[float, float]], *, short: tuple[int, ...] = (), unit: float = 1000.0) -> Any:
    """Of 100 windows whose two states are off by one unit each, to one side or the other, all along; some by more."""
    off = np.where(np.arange(100) % 2, 1.0, -1.0)[:, None] * np.ones(2)
    for window, times in pushes.items():
        off[window] *= times
    residual = np.repeat((off * np.array([1.0, unit]))[:, None], 8, axis=1)
    steps = np.where(np.isin(np.arange(100), short), 4, 8)
    shooting: Any = SimpleNamespace(windows=SimpleNamespace(steps=steps), rows=np.arange(1, 9))
    return _counts(shooting, residual)


def test_a_window_that_was_pushed_hard_counts_by_the_inverse_square_of_how_far_it_is_off() -> None:
    found = weights({10: (40.0, 40.0), 11: (80.0, 80.0), 13: (160.0, 160.0)})
    assert np.ptp(found[10]) == 0.0
    own = found[:, 0, 0]
    assert (own[[0, 1, 2, 50, 99]] == 1.0).all()
    assert 0.0 < own[13] < own[11] < own[10] < 1.0
    assert own[10] / own[11] == pytest.approx(4.0)
    assert own[10] / own[13] == pytest.approx(16.0)


def test_each_state_is_weighed_in_its_own_unit_and_each_window_by_its_own_rows() -> None:
    """A heading that is off by 40 of what is usual is as bad as a place that is."""
    found = weights({20: (40.0, 1.0), 21: (1.0, 40.0), 30: (40.0, 40.0), 31: (40.0, 40.0)}, short=(31, 33))
    own = found[:, 0, 0]
    assert own[20] == pytest.approx(own[21])
    assert own[20] < 1.0
    assert own[30] == pytest.approx(own[31])
    assert own[33] == 1.0
    assert found[31, :, 0].tolist() == [own[31]] * 4 + [0.0] * 4, "rows behind a short window's end are none"


def test_the_usual_residual_is_the_root_of_the_mean_square_of_all_but_the_largest_twentieth() -> None:
    """Of 3 and 4 it is the root of 12.5; what stands beside a count of 0 is not there."""
    residual = np.array([[3.0, 0.0], [-4.0, 0.0]] * 19 + [[900.0, 0.0], [-900.0, 0.0]]).reshape(40, 1, 2)
    there = np.ones_like(residual)
    found = _robust(residual, there)
    assert found[0] == pytest.approx(12.5**0.5)
    assert 0.0 < found[1] < 1e-6
    residual[0], there[0] = 1e9, 0.0
    assert _robust(residual, there)[0] == pytest.approx((466.0 / 37.0) ** 0.5)


def test_of_a_single_row_the_usual_residual_is_itself() -> None:
    residual, there = np.array([[[3.0]], [[9.0]]]), np.array([[[1.0]], [[0.0]]])
    assert _robust(residual, there) == pytest.approx([3.0])


def test_the_objective_is_the_mean_logarithm_of_each_states_root_mean_square() -> None:
    """Of 30 numbers with a mean square of 4, and 10 with one of 9: (30 log 2 + 10 log 3) / 40."""
    squares = np.array([[120.0, 30.0], [90.0, 10.0]])  # of two models
    elimination = SimpleNamespace(products=lambda own: own, squares=lambda own, _: own)
    shooting: Any = SimpleNamespace(elimination=elimination, size=np.array([30.0, 10.0]))
    found = objectives(squares, shooting, np.ones(2))
    assert found[0] == pytest.approx((30.0 * np.log(2.0) + 10.0 * np.log(3.0)) / 40.0)
    assert found[1] == pytest.approx(0.0)
