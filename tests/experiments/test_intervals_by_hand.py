"""Intervals of means and of ratios of means, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa_lab.experiments.statistics import mean_interval, ratio_interval


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
