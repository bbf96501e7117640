"""Intervals for shares, means and ratios of means."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

__all__ = ["mean_interval", "ratio_interval", "wilson_interval"]

_NORMAL_95 = 1.959963984540054


def wilson_interval(hits: int, trials: int) -> tuple[float, float]:
    """95 % score interval of the share hits / trials. Source: Wilson, JASA 22 (1927) 209.

    Raises ValueError unless 0 <= hits <= trials and trials > 0.
    """
    if not 0 <= hits <= trials or trials == 0:
        raise ValueError(f"got {hits} hits of {trials} trials, wanted 0 <= hits <= trials, trials > 0")
    share, square = hits / trials, _NORMAL_95**2
    centre = share + square / (2 * trials)
    spread = _NORMAL_95 * sqrt(share * (1 - share) / trials + square / (4 * trials**2))
    scale = 1 + square / trials
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


def mean_interval(values: NDArray[np.float64]) -> list[float]:
    """Mean of independent values, and the ends of its 95 % interval: mean -+ 1.96 deviation / sqrt(n)."""
    mean = float(np.mean(values))
    spread = _NORMAL_95 * float(np.std(values, ddof=1)) / sqrt(len(values)) if len(values) > 1 else float("inf")
    return [mean, mean - spread, mean + spread]


def ratio_interval(values: NDArray[np.float64], others: NDArray[np.float64]) -> list[float]:
    """Ratio r of the means of values that belong in pairs, and the ends of its 95 % interval by the delta method.

    The deviation is that of (value - r other) / mean of the others. Raises ValueError when their mean is 0.
    """
    if len(values) != len(others) or not np.mean(others):
        raise ValueError(f"got {len(values)} values, {len(others)} others; wanted pairs whose others' mean is not 0")
    ratio, below = float(np.mean(values) / np.mean(others)), float(np.mean(others))
    _, low, high = mean_interval((values - ratio * others) / below)
    return [ratio, ratio + low, ratio + high]
