"""Intervals of means, ratios and shares by hand, and against SciPy's."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from safedpa_lab.experiments.statistics import (
    clopper_pearson_interval,
    cluster_interval,
    coverage_row,
    mean_interval,
    ratio_interval,
    seeds_interval,
    wilson_interval,
)


def test_a_mean_and_its_interval() -> None:
    """Deviation 2 of four values: 1.96 * 2 / 2."""
    found = mean_interval(np.array([1.0, 1.0, 4.0, 4.0]) * 2.0 / np.sqrt(3.0))
    assert found == pytest.approx([5.0 / np.sqrt(3.0) + way * 1.96 for way in (0.0, -1.0, 1.0)], abs=1e-4)


@pytest.mark.parametrize("unit", [1.0, 60.0])
def test_a_ratio_and_its_interval_by_the_delta_method(unit: float) -> None:
    """r = 3 / 2; (v - r o) / 2 is 0.25 and -0.25, whose mean has the error 0.25; units cancel."""
    found = ratio_interval(unit * np.array([2.0, 4.0]), unit * np.array([1.0, 3.0]))
    assert found == pytest.approx([1.5, 1.5 - 1.96 * 0.25, 1.5 + 1.96 * 0.25], abs=1e-4)


def test_what_has_no_pairs_or_no_ratio_is_refused() -> None:
    for others in (np.array([1.0]), np.array([1.0, -1.0])):
        with pytest.raises(ValueError, match="wanted pairs whose others' mean is not 0"):
            ratio_interval(np.array([1.0, 2.0]), others)


def test_one_value_says_nothing_of_its_error() -> None:
    assert mean_interval(np.array([3.0])) == [3.0, -math.inf, math.inf]


@pytest.mark.parametrize(
    ("values", "mean", "half"),
    [
        ([0.0, 2.0], 1.0, 12.7062),  # deviation sqrt(2) of two: 1
        ([1.0, 2.0, 3.0], 2.0, 4.30265 / np.sqrt(3.0)),
        ([1.0, 1.0, 4.0, 4.0], 2.5, 3.18245 * np.sqrt(3.0) / 2.0),
        ([5.0] * 5, 5.0, 0.0),
        ([0.0, 0.0, 0.0, 0.0, 5.0], 1.0, 2.77645),  # deviation sqrt(5) of five
    ],
)
def test_means_over_training_seeds_have_students_interval(values: list[float], mean: float, half: float) -> None:
    """The 97.5 % points of Student's t from its table: 12.706, 4.303, 3.182 and 2.776 for 1, 2, 3 and 4 degrees."""
    assert seeds_interval(np.array(values)) == pytest.approx([mean, mean - half, mean + half], abs=1e-4)


def test_one_training_seed_says_nothing_of_others_and_none_is_refused() -> None:
    assert seeds_interval(np.array([3.0])) == [3.0, -math.inf, math.inf]
    with pytest.raises(ValueError, match="got no value, wanted one at least"):
        seeds_interval(np.array([]))


SHARES = [(0, 1), (1, 1), (0, 7), (3, 7), (7, 7), (1, 40), (39, 40), (200, 1000), (11, 11)]


@pytest.mark.parametrize(("hits", "trials"), SHARES)
def test_intervals_of_a_share_are_scipys(hits: int, trials: int) -> None:
    found = stats.binomtest(hits, trials)
    for interval, method in ((wilson_interval, "wilson"), (clopper_pearson_interval, "exact")):
        wanted = found.proportion_ci(0.95, method)
        assert interval(hits, trials) == pytest.approx((wanted.low, wanted.high), abs=1e-12)
        low, high = interval(hits, trials)
        assert 0.0 <= low <= hits / trials + 1e-15
        assert hits / trials - 1e-15 <= high <= 1.0


@pytest.mark.parametrize("interval", [wilson_interval, clopper_pearson_interval])
@pytest.mark.parametrize(("hits", "trials"), [(-1, 3), (4, 3), (0, 0), (1, 0)])
def test_what_is_no_share_is_refused(interval: object, hits: int, trials: int) -> None:
    with pytest.raises(ValueError, match="wanted 0 <= hits <= trials, trials > 0"):
        interval(hits, trials)  # type: ignore[operator]


@pytest.mark.parametrize("share", [1.0, 0.8])
@pytest.mark.parametrize("drives", [1, 2, 20])
def test_drives_that_are_all_alike_are_counted(share: float, drives: int) -> None:
    """That a share of n is none of them has the one-sided chance 0.025 where it is 1 - 0.025^(1/n)."""
    low, high = cluster_interval(np.full(drives, share))
    assert (low, high) == (pytest.approx(share * 0.025 ** (1.0 / drives)), share)


def test_whole_drives_are_drawn() -> None:
    """Mean of 400 drives: the normal law; and of two drives every one of the four draws counts a quarter."""
    shares = np.random.default_rng(5).uniform(0.5, 1.0, 400)
    mean, error = shares.mean(), shares.std() / 20.0
    assert cluster_interval(shares) == pytest.approx((mean - 1.96 * error, mean + 1.96 * error), abs=0.1 * error)
    assert cluster_interval(np.array([0.2, 0.8])) == (0.2, 0.8)
    assert cluster_interval(shares) == cluster_interval(shares), "the same each time"
    assert cluster_interval(shares, seed=1) != cluster_interval(shares)
    with pytest.raises(ValueError, match="got no drive"):
        cluster_interval(np.zeros(0))


@pytest.mark.parametrize(
    ("shares", "low", "high"),
    [
        ([0.0, 0.0, 0.0, 1.0], 0.0, 0.75),  # of 256 draws of four one is all 1, and 12 are 1 three times
        ([1.0, 1.0, 1.0, 0.0], 0.25, 1.0),
        ([0.0, 0.0, 1.0], 0.0, 1.0),  # of 27 draws of three one is all 1
        ([0.0] * 9 + [1.0], 0.0, 0.3),  # four of ten with a chance of 0.0128, three of 0.0702
    ],
)
def test_as_many_drives_are_drawn_as_there_are(shares: list[float], low: float, high: float) -> None:
    """Counted out: the least share that no more than a fortieth of all draws exceeds, at either end."""
    for seed in range(3):
        assert cluster_interval(np.array(shares), seed=seed) == pytest.approx((low, high))


def test_a_row_tells_steps_and_whole_drives() -> None:
    shares = np.array([1.0, 1.0, 0.5, 0.9, 1.0])
    row = coverage_row(shares, 0.03)
    assert (row["epsilon"], row["steps"], row["drives"]) == (0.03, pytest.approx(0.88), 0.6)
    assert row["steps_95"] == list(cluster_interval(shares))
    assert row["drives_95"] == list(clopper_pearson_interval(3, 5))
