"""The gain on unseen blocks: a normal deviate, however few blocks there are."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from safedpa.diagnosis.fit.trial import block_gain


def gain(differences):
    """The gain where the squares of each block differ by so much, over a mean square of 1."""
    count = len(differences)
    order = np.arange(count)
    shooting = SimpleNamespace(block=order, by_block=order, first_of_block=order, size=np.array([float(count)]))
    other = SimpleNamespace(heldout=np.full((count, 1), 1.0))
    one = SimpleNamespace(heldout=1.0 + np.asarray(differences)[:, None])
    return block_gain(one, other, shooting)


@pytest.mark.parametrize("count", [8, 12, 40, 200])
@pytest.mark.parametrize("shift", [-0.5, 0.3, 1.0, 3.0])
def test_it_is_the_normal_deviate_of_a_t_test(count, shift):
    values = 4.0 * (np.random.default_rng(count).normal(size=count) + shift)
    ratio = values.sum() / np.hypot(values.std(ddof=1) * np.sqrt(count), 1.0)
    wanted = np.sign(ratio) * stats.norm.isf(stats.t.sf(abs(ratio), count - 1))
    assert gain(values) == pytest.approx(wanted, rel=0.02)


def test_steady_gains_of_few_blocks_are_no_proof():
    assert gain([1.0, 1.01, 0.99, 1.0, 1.0, 1.01, 0.99]) == 0.0
    assert gain(5.0 + 0.1 * np.arange(8)) < 8.0


def test_the_same_squares_gain_nothing():
    assert gain(np.zeros(20)) == 0.0
