"""Intervals and paired tests, compared with their definitions, with what is counted by hand, and with SciPy."""

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.stats import binomtest

from safedpa_lab.experiments.common.statistics import (
    clopper_pearson_interval,
    cluster_interval,
    coverage_row,
    holm,
    mcnemar_exact,
    mean_interval,
    ratio_interval,
    seeds_interval,
    sign_flip_exact,
    wilson_interval,
)

SHARES = st.integers(1, 1000).flatmap(lambda trials: st.tuples(st.integers(0, trials), st.just(trials)))
VALUES = st.lists(st.floats(-100.0, 100.0), min_size=2, max_size=20)


@given(SHARES)
def test_intervals_of_a_share_are_scipys_and_contain_the_share(share: tuple[int, int]) -> None:
    hits, trials = share
    found = stats.binomtest(hits, trials)
    for interval, method in ((wilson_interval, "wilson"), (clopper_pearson_interval, "exact")):
        wanted = found.proportion_ci(0.95, method)
        low, high = interval(hits, trials)
        assert (low, high) == pytest.approx((wanted.low, wanted.high), abs=1e-12)
        assert 0.0 <= low <= hits / trials + 1e-15
        assert hits / trials - 1e-15 <= high <= 1.0


@pytest.mark.parametrize("interval", [wilson_interval, clopper_pearson_interval])
@pytest.mark.parametrize(("hits", "trials"), [(-1, 3), (4, 3), (0, 0), (1, 0)])
def test_an_impossible_share_is_refused(interval: object, hits: int, trials: int) -> None:
    with pytest.raises(ValueError, match="wanted 0 <= hits <= trials, trials > 0"):
        interval(hits, trials)  # type: ignore[operator]


@given(VALUES)
def test_a_mean_has_the_interval_of_its_standard_error(values: list[float]) -> None:
    """By the normal law; over few training seeds by Student's t."""
    error = np.std(values, ddof=1) / math.sqrt(len(values))
    for interval, wide in ((mean_interval, 1.959964), (seeds_interval, stats.t.ppf(0.975, len(values) - 1))):
        wanted = [np.mean(values) + way * wide * error for way in (0.0, -1.0, 1.0)]
        assert interval(np.array(values)) == pytest.approx(wanted, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("interval", [mean_interval, seeds_interval])
def test_one_value_says_nothing_about_its_error(interval: object) -> None:
    assert interval(np.array([3.0])) == [3.0, -math.inf, math.inf]  # type: ignore[operator]


@pytest.mark.parametrize("unit", [1.0, 60.0])
def test_a_ratio_has_the_interval_of_the_delta_method(unit: float) -> None:
    """r = 3 / 2; (v - r o) / 2 is 0.25 and -0.25, whose mean has the error 0.25; units cancel."""
    found = ratio_interval(unit * np.array([2.0, 4.0]), unit * np.array([1.0, 3.0]))
    assert found == pytest.approx([1.5, 1.5 - 1.96 * 0.25, 1.5 + 1.96 * 0.25], abs=1e-4)


def test_values_without_a_mean_or_a_ratio_are_refused() -> None:
    for others in (np.array([1.0]), np.array([1.0, -1.0])):
        with pytest.raises(ValueError, match="wanted pairs whose others' mean is not 0"):
            ratio_interval(np.array([1.0, 2.0]), others)
    with pytest.raises(ValueError, match="got no value, wanted one at least"):
        seeds_interval(np.array([]))
    with pytest.raises(ValueError, match="got no drive"):
        cluster_interval(np.zeros(0))


@pytest.mark.parametrize("share", [1.0, 0.8])
@pytest.mark.parametrize("drives", [1, 2, 20])
def test_drives_that_are_all_alike_leave_room_for_others(share: float, drives: int) -> None:
    """That a share of n is none of them has the one-sided chance 0.025 where it is 1 - 0.025^(1/n)."""
    low, high = cluster_interval(np.full(drives, share))
    assert (low, high) == (pytest.approx(share * 0.025 ** (1.0 / drives)), share)


def test_whole_drives_are_drawn_and_the_same_each_time() -> None:
    """The mean of 400 drives follows the normal law."""
    shares = np.random.default_rng(5).uniform(0.5, 1.0, 400)
    mean, error = shares.mean(), shares.std() / 20.0
    assert cluster_interval(shares) == pytest.approx((mean - 1.96 * error, mean + 1.96 * error), abs=0.1 * error)
    assert cluster_interval(shares) == cluster_interval(shares)
    assert cluster_interval(shares, seed=1) != cluster_interval(shares)


@pytest.mark.parametrize(
    ("shares", "low", "high"),
    [
        ([0.2, 0.8], 0.2, 0.8),  # each of the four draws has a quarter
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


def test_a_row_of_coverage_counts_steps_and_whole_drives() -> None:
    shares = np.array([1.0, 1.0, 0.5, 0.9, 1.0])
    row = coverage_row(shares, 0.03)
    assert (row["epsilon"], row["steps"], row["drives"]) == (0.03, pytest.approx(0.88), 0.6)
    assert row["steps_95"] == list(cluster_interval(shares))
    assert row["drives_95"] == list(clopper_pearson_interval(3, 5))


@pytest.mark.parametrize("seed", range(6))
def test_mcnemar_is_a_binomial_test_of_where_they_differ(seed: int) -> None:
    random = np.random.default_rng(seed)
    one, other = random.random(40) < 0.8, random.random(40) < 0.5
    more, fewer, p = mcnemar_exact(one, other)
    assert (more, fewer) == (int((one & ~other).sum()), int((other & ~one).sum()))
    assert p == pytest.approx(binomtest(more, more + fewer).pvalue, rel=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_the_exchange_of_directions_is_counted_out(seed: int) -> None:
    random = np.random.default_rng(seed)
    one, other = random.random(24) < 0.8, random.random(24) < 0.5
    differences = (one.astype(int) - other.astype(int)).reshape(8, 3).sum(1)
    totals = [abs(np.dot(signs, differences)) for signs in product((-1, 1), repeat=8)]
    wanted = np.mean([total >= abs(differences.sum()) for total in totals])
    assert sign_flip_exact(one, other, 8) == pytest.approx(wanted)


def test_holm_multiplies_by_what_is_left() -> None:
    assert (holm([0.01, 0.04, 0.03]), holm([0.9, 0.8])) == (pytest.approx([0.03, 0.06, 0.06]), [1.0, 1.0])
    assert holm([]) == []


def test_flags_of_other_episodes_are_refused() -> None:
    for one, other in ((np.ones(3), np.ones(4)), (np.ones(0), np.ones(0)), (np.ones((2, 2)), np.ones((2, 2)))):
        with pytest.raises(ValueError, match="one each of every episode"):
            mcnemar_exact(one.astype(bool), other.astype(bool))
    for count, groups in ((4, 3), (6, 0), (6, -1)):
        with pytest.raises(ValueError, match="as many in each"):
            sign_flip_exact(np.ones(count, dtype=bool), np.zeros(count, dtype=bool), groups)


@pytest.mark.parametrize(
    ("one", "other", "groups", "p", "pairs"),
    [
        ("101", "101", 3, 1.0, (0, 0, 1.0)),
        ("1", "0", 1, 1.0, (1, 0, 1.0)),  # one episode alone is an episode
        ("1" * 6, "0" * 6, 1, 1.0, (6, 0, 2 / 64)),  # one group proves nothing
        ("1" * 6, "0" * 6, 2, 0.5, (6, 0, 2 / 64)),
        ("1" * 480, "0" * 20 + "1" * 460, 24, 1.0, (20, 0, 2 / 2**20)),  # lost in a single wind: one event, not twenty
        ("1111", "0000", 4, 2 / 16, (4, 0, 2 / 16)),  # all alike: both ways round, of the sixteen exchanges of four
        ("1110", "0000", 4, 2 / 8, (3, 0, 2 / 8)),
        ("1110", "0001", 4, 10 / 16, (3, 1, 10 / 16)),  # 3 less 1: whose total is 2 or more, or -2 or less
        ("1100", "0011", 4, 1.0, (2, 2, 1.0)),
    ],
)
def test_paired_tests_are_symmetric_in_better_and_worse(one, other, groups, p, pairs) -> None:
    flags = [np.array([letter == "1" for letter in word]) for word in (one, other)]
    assert sign_flip_exact(flags[0], flags[1], groups) == sign_flip_exact(flags[1], flags[0], groups) == p
    assert mcnemar_exact(*flags) == pytest.approx(pairs)
    assert mcnemar_exact(*reversed(flags)) == pytest.approx((pairs[1], pairs[0], pairs[2]))
