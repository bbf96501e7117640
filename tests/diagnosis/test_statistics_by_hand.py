"""Deviations, errors and their factors, against numbers by hand, or against what NumPy and SciPy make of noise."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from safedpa.compare.comparison import _own_findings
from safedpa.diagnosis.fit.heldout import HeldoutError
from safedpa.diagnosis.fit.shooting import _robust
from safedpa.diagnosis.fit.trial import deviates_of
from safedpa.diagnosis.rehearsal import measured_noise
from safedpa.diagnosis.remains.by_name import _sure
from safedpa.dynamics import load_model
from safedpa.fleet.common import _coin
from safedpa.fleet.pooled_evidence import _close, _evidence
from safedpa.live.forecasts import Forecast, stretch_error
from safedpa.live.watch import _by_channel, _heading

CAR = load_model("car").system


def test_the_robust_size_leaves_the_largest_twentieth_out() -> None:
    """Of 40 rows two are left out, and rows without a count are none; of two rows the smaller one stays."""
    values = np.concatenate([np.full(19, 3.0), np.full(19, -4.0), [1e3, -1e6]])
    residual = np.stack([values, np.zeros(40)], axis=-1)[None]
    found = _robust(residual, np.ones_like(residual))
    assert found[0] == pytest.approx(math.sqrt(12.5))
    assert found[1] == 1e-7, "never 0"
    few = np.array([[[3.0], [5.0], [7e5]]])
    assert _robust(few, np.array([[[1.0], [1.0], [0.0]]])) == pytest.approx([3.0])


@pytest.mark.parametrize(("hits", "trials"), [(26, 50), (40, 50), (30, 51), (60, 100), (110, 200), (520, 1000)])
def test_so_many_heads_of_a_fair_coin_come_as_often_as_the_binomial_law_says(hits: int, trials: int) -> None:
    assert _coin(hits, trials) == pytest.approx(float(stats.binom.sf(hits - 1, trials, 0.5)), rel=0.03)


def test_a_gain_is_told_in_standard_errors_of_the_sum_of_blocks() -> None:
    """Four blocks whose sums are 1, 2, 3 and 6: sum 12, deviation sqrt(14 / 3), its error twice that."""
    difference, block = np.array([0.5, 0.5, 2.0, 1.0, 2.0, 4.0, 2.0]), np.array([0, 0, 2, 3, 3, 5, 5])
    assert _sure(difference, block) == pytest.approx(12.0 / (2.0 * math.sqrt(14.0 / 3.0)))
    assert _sure(difference, np.zeros(7, dtype=int)) == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_a_gain_over_few_blocks_has_the_deviate_of_students_law(seed: int) -> None:
    """As far out in the normal law as t is in Student's, to a part in fifty."""
    size, blocks = 10, 12
    differences = np.random.default_rng(seed).normal(3.0, 4.0, size * blocks)
    shooting: Any = SimpleNamespace(first_of_block=np.arange(0, size * blocks, size), by_block=np.arange(size * blocks))
    (found,) = deviates_of(differences[None], shooting)
    t = stats.ttest_1samp(differences.reshape(blocks, size).sum(axis=1), 0.0)
    assert found == pytest.approx(stats.norm.isf(t.pvalue / 2.0) * np.sign(t.statistic), rel=0.02)
    assert deviates_of(-differences[None], shooting)[0] == pytest.approx(-found)


def test_noise_is_measured_beside_any_steady_motion() -> None:
    deviations, random = np.array([0.002, 0.05, 0.3, 1.0]), np.random.default_rng(4)
    t = 0.05 * np.arange(4000.0)[:, None]
    states = np.array([1.0, -2.0, 0.3, 4.0]) * t + random.normal(0.0, deviations, (4000, 4))
    run: Any = SimpleNamespace(parts=lambda: [(t[:, 0], states, None)], system=CAR)
    assert measured_noise([run]) == pytest.approx(deviations, rel=0.1)


def test_the_error_over_folds_is_that_of_a_mean() -> None:
    by_fold = np.array([0.2, 0.5, np.nan, 0.3, 0.6])
    error = HeldoutError(0.4, by_fold, by_fold, by_fold, by_fold, by_fold)
    assert error.standard_error == pytest.approx(float(stats.sem([0.2, 0.5, 0.3, 0.6])))
    assert HeldoutError(0.4, by_fold, by_fold, by_fold, by_fold[:1], by_fold).standard_error == 0.0


def test_evidence_of_a_fleet_is_stouffers_sum() -> None:
    found = _evidence("drag", {"r1": 3.0, "r2": -1.0, "r3": 2.0, "r4": 4.0})
    assert (found.robots, found.favourable) == (4, 3)
    assert found.score == pytest.approx(
        stats.combine_pvalues(stats.norm.sf([3.0, -1.0, 2.0, 4.0]), "stouffer").statistic
    )


@pytest.mark.parametrize(("mean", "close"), [(1.9, True), (2.1, False)])
def test_two_effects_are_close_where_their_difference_is_less_than_two_standard_errors(
    mean: float, close: bool
) -> None:
    differences = np.array([-3.0, -1.0, 1.0, 3.0, -2.0, 2.0])
    differences = (differences + mean * stats.sem(differences)).tolist()
    other = {f"r{k}": 5.0 for k in range(6)}
    best = {name: 5.0 + value for name, value in zip(other, differences, strict=True)}
    assert _close({**best, "alone": 9.0}, other) is close


@pytest.mark.parametrize(("jitter", "told"), [(0.15, False), (0.25, True)])
@pytest.mark.parametrize("period", [0.02, 0.5])
def test_uneven_periods_are_told_from_a_fifth_of_the_period_on(jitter: float, told: bool, period: float) -> None:
    """A tenth of the periods is longer by so much."""
    steps = np.full(100, period)
    steps[::10] *= 1.0 + jitter
    t = np.concatenate([[0.0], np.cumsum(steps)])
    run: Any = SimpleNamespace(parts=lambda: [(t, None, None)], period=period)
    windows: Any = SimpleNamespace(horizon=1.0)
    found = _own_findings(run, windows, np.ones(3, dtype=bool), np.zeros((3, 4)))
    assert [item.kind for item in found] == (["irregular_sampling"] if told else [])
    if told:
        assert "by more than 25%" in found[0].message


def forecast(began: Any, measured: Any, predicted: Any) -> Forecast:
    return Forecast(0, 20, *map(np.array, (began, measured, predicted)), np.zeros(2), np.zeros(2))


def test_the_error_of_a_stretch_is_a_root_mean_square_in_scales() -> None:
    still = [0.0] * 4
    stretch = [forecast(still, [3.0, 0.0, 0.0, 1.0], still), forecast(still, [4.0, 0.0, 0.0, -1.0], still)]
    scale = np.array([2.0, 0.0, 0.0, 0.5])
    assert stretch_error(CAR, stretch, scale) == pytest.approx(0.5 * (math.sqrt(12.5) / 2.0 + 1.0 / 0.5))


def test_along_and_across_the_heading_the_scale_is_that_of_the_place() -> None:
    assert _by_channel(CAR, np.array([3.0, 4.0, 0.5, 7.0])) == pytest.approx([math.sqrt(12.5)] * 2 + [0.5, 7.0])


@pytest.mark.parametrize("towards", [-120, 0, 60])
@pytest.mark.parametrize("size", [1e-3, 1.0, 40.0])
def test_an_error_that_turns_with_the_heading_is_told_with_where_to(towards: int, size: float) -> None:
    """Whatever its size; with as much noise as signal it is not told."""
    headings = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    forecasts = [forecast([0.0, 0.0, yaw, 1.0], [0.0] * 4, [0.0] * 4) for yaw in headings]
    errors = size * np.cos(headings - math.radians(towards))
    assert _heading(CAR, forecasts, errors) == f", turning with the heading (most towards {towards} degrees)"
    noise = size * np.random.default_rng(2).permutation(np.repeat([-1.0, 1.0], 20))
    assert _heading(CAR, forecasts, errors + 2.0 * noise) == ""
