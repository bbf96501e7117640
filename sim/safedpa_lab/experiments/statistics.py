"""Intervals for shares, means and ratios of means."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "clopper_pearson_interval",
    "cluster_interval",
    "coverage_row",
    "mean_interval",
    "ratio_interval",
    "seeds_interval",
    "wilson_interval",
]

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


def clopper_pearson_interval(hits: int, trials: int) -> tuple[float, float]:
    """95 % interval of the share hits / trials that covers at least as often as it says, for any share.

    Source: Clopper and Pearson, Biometrika 26 (1934) 404. Raises ValueError unless 0 <= hits <= trials and trials > 0.
    """
    from scipy.stats import beta

    if not 0 <= hits <= trials or trials == 0:
        raise ValueError(f"got {hits} hits of {trials} trials, wanted 0 <= hits <= trials, trials > 0")
    low = float(beta.ppf(0.025, hits, trials - hits + 1)) if hits else 0.0
    high = float(beta.ppf(0.975, hits + 1, trials - hits)) if hits < trials else 1.0
    return low, high


def cluster_interval(shares: NDArray[np.float64], seed: int = 0, draws: int = 4000) -> tuple[float, float]:
    """95 % interval of the mean of shares (drives,), one a drive, by drawing whole drives with replacement.

    Steps of one drive are alike; an interval that counts them as independent is too narrow. Where all shares are 1 the
    drives are counted instead: a share below 1 in none of n drives. Raises ValueError without a drive.
    """
    values = np.asarray(shares, dtype=np.float64)
    if not len(values):
        raise ValueError("got no drive, wanted one at least")
    if values.min() == values.max():
        return float(values[0]) * clopper_pearson_interval(len(values), len(values))[0], float(values[0])
    picked = np.random.default_rng(seed).integers(0, len(values), (draws, len(values)))
    low, high = np.quantile(values[picked].mean(axis=1), [0.025, 0.975])
    return float(low), float(high)


def mean_interval(values: NDArray[np.float64]) -> list[float]:
    """Mean of independent values, and the ends of its 95 % interval: mean -+ 1.96 deviation / sqrt(n)."""
    mean = float(np.mean(values))
    spread = _NORMAL_95 * float(np.std(values, ddof=1)) / sqrt(len(values)) if len(values) > 1 else float("inf")
    return [mean, mean - spread, mean + spread]


def seeds_interval(values: NDArray[np.float64]) -> list[float]:
    """Mean of a few values, one a training seed, and the ends of its 95 % interval by Student's t: mean -+ t s/sqrt(n).

    Infinite for one value. Raises ValueError for none.
    """
    from scipy.stats import t

    if not len(values):
        raise ValueError("got no value, wanted one at least")
    mean, count = float(np.mean(values)), len(values)
    if count == 1:
        return [mean, -float("inf"), float("inf")]
    spread = float(t.ppf(0.975, count - 1)) * float(np.std(values, ddof=1)) / sqrt(count)
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


def coverage_row(shares: NDArray[np.float64], epsilon: float) -> dict[str, Any]:
    """What a margin ``epsilon`` covers of fresh drives, whose shares of covered steps are ``shares`` (drives,).

    ``steps``: their mean, with the interval over drives; ``drives``: the share of those covered whole; 95 % each.
    """
    whole = int((shares == 1.0).sum())
    return {
        "epsilon": epsilon,
        "steps": float(shares.mean()),
        "steps_95": list(cluster_interval(shares)),
        "drives": whole / len(shares),
        "drives_95": list(clopper_pearson_interval(whole, len(shares))),
    }
