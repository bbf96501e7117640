"""How many standard errors one set of terms is better by, on squares that are given."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.diagnosis.remains.weak_form import Regression


def regression(blocks: int, each: int) -> Regression:
    """So many blocks of so many windows; their residuals are not asked for."""
    windows = blocks * each
    return Regression(
        residual=np.zeros((windows, 1)),
        columns=np.zeros((windows, 1, 1)),
        always=0,
        fold=np.zeros(windows, dtype=np.int64),
        block=np.repeat(np.arange(blocks), each),
    )


def by_hand(difference: list[float], each: int) -> float:
    sums = [sum(difference[first : first + each]) for first in range(0, len(difference), each)]
    mean = sum(sums) / len(sums)
    variance = sum((one - mean) ** 2 for one in sums) / (len(sums) - 1)
    return sum(sums) / (variance**0.5 * len(sums) ** 0.5)


def test_the_sum_of_blocks_over_its_standard_error() -> None:
    gains = [1.0, 2.0, 3.0, 1.0, 2.0, 4.0, 2.0, 1.0, 3.0, 2.0, 5.0, 1.0, 2.0, 2.0, 3.0, 1.0, 2.0, 4.0]
    found = regression(9, 2).sure(np.array(gains) + 7.0, np.full(18, 7.0))
    assert found == pytest.approx(by_hand(gains, 2))


def test_a_glitch_counts_three_times_what_nine_tenths_stay_below_where_few_windows_are_concerned() -> None:
    """40 blocks of one window: 25 with nothing, 14 with 1 to 2, one glitch: 0.9 of them stay below 1.6."""
    gains = [0.0] * 25 + [1.0 + 0.1 * number for number in range(10)] + [2.0] * 4 + [1e6]
    most = 3.0 * float(np.quantile(np.abs(gains), 0.9))
    assert 5.0 < most < 6.5
    found = regression(40, 1).sure(np.array(gains), np.zeros(40))
    assert found == pytest.approx(by_hand([min(gain, most) for gain in gains], 1), rel=1e-9)


def test_a_glitch_counts_twenty_medians_where_all_windows_are_concerned() -> None:
    gains = [1.0, 1.1] * 8 + [1e6, 1.0]
    found = regression(18, 1).sure(np.array(gains), np.zeros(18))
    assert found == pytest.approx(by_hand([min(gain, 20.0 * float(np.median(gains))) for gain in gains], 1), rel=1e-9)


def test_of_fewer_than_eight_blocks_nothing_is_sure() -> None:
    assert regression(7, 3).sure(np.full(21, 2.0), np.ones(21)) == 0.0
    assert regression(8, 3).sure(np.full(24, 2.0), np.linspace(0.5, 1.0, 24)) > 0.0
