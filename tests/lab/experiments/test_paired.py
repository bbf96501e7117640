"""Paired tests of significance against what can be counted by hand, and against scipy."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.stats import binomtest

from safedpa_lab.experiments.paired import holm, mcnemar_exact, sign_flip_exact


@pytest.mark.parametrize("seed", range(6))
def test_mcnemar_is_a_binomial_test_of_where_they_differ(seed: int) -> None:
    random = np.random.default_rng(seed)
    one, other = random.random(40) < 0.8, random.random(40) < 0.5
    more, fewer, p = mcnemar_exact(one, other)
    assert (more, fewer) == (int((one & ~other).sum()), int((other & ~one).sum()))
    assert p == pytest.approx(binomtest(more, more + fewer).pvalue, rel=1e-12)


def test_equal_flags_show_no_difference() -> None:
    same = np.array([True, False, True])
    assert mcnemar_exact(same, same) == (0, 0, 1.0)
    assert sign_flip_exact(same, same, 3) == 1.0


@pytest.mark.parametrize("seed", range(6))
def test_the_exchange_of_directions_is_counted_out(seed: int) -> None:
    random = np.random.default_rng(seed)
    one, other = random.random(24) < 0.8, random.random(24) < 0.5
    differences = (one.astype(int) - other.astype(int)).reshape(8, 3).sum(1)
    totals = [abs(np.dot(signs, differences)) for signs in product((-1, 1), repeat=8)]
    wanted = np.mean([total >= abs(differences.sum()) for total in totals])
    assert sign_flip_exact(one, other, 8) == pytest.approx(wanted)


def test_one_direction_alone_proves_nothing() -> None:
    """Twenty episodes that are lost in a single wind are one event, not twenty."""
    one, other = np.ones(480, dtype=bool), np.ones(480, dtype=bool)
    other[:20] = False
    assert mcnemar_exact(one, other)[2] < 1e-5
    assert sign_flip_exact(one, other, 24) == 1.0


def test_one_group_proves_nothing_and_none_is_refused() -> None:
    one, other = np.ones(6, dtype=bool), np.zeros(6, dtype=bool)
    assert sign_flip_exact(one, other, 1) == 1.0
    assert sign_flip_exact(one, other, 2) == 0.5
    for groups in (0, -1):
        with pytest.raises(ValueError, match="as many in each"):
            sign_flip_exact(one, other, groups)


def test_holm_multiplies_by_what_is_left() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


def test_flags_of_other_episodes_are_refused() -> None:
    with pytest.raises(ValueError, match="one each of every episode"):
        mcnemar_exact(np.ones(3, dtype=bool), np.ones(4, dtype=bool))
    with pytest.raises(ValueError, match="as many in each"):
        sign_flip_exact(np.ones(4, dtype=bool), np.ones(4, dtype=bool), 3)
    for nothing in (np.ones(0, dtype=bool), np.ones((2, 2), dtype=bool)):
        with pytest.raises(ValueError, match="one each of every episode"):
            mcnemar_exact(nothing, nothing)


def test_one_episode_alone_is_an_episode() -> None:
    assert mcnemar_exact(np.array([True]), np.array([False])) == (1, 0, 1.0)
    assert sign_flip_exact(np.array([False]), np.array([True]), 1) == 1.0


@pytest.mark.parametrize(
    ("one", "other", "p"),
    [
        ("1111", "0000", 2 / 16),  # all alike: both ways round, of the sixteen exchanges of four
        ("1110", "0000", 2 / 8),
        ("1110", "0001", 10 / 16),  # 3 less 1: whose total is 2 or more, or -2 or less
        ("1100", "0011", 1.0),
    ],
)
def test_the_test_is_symmetric_in_better_and_worse(one: str, other: str, p: float) -> None:
    flags = [np.array([letter == "1" for letter in word]) for word in (one, other)]
    assert sign_flip_exact(flags[0], flags[1], 4) == p
    assert sign_flip_exact(flags[1], flags[0], 4) == p
