"""Intervals of shares and means, and exact tests of whether one method is better than another on the same episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import comb, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray

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


def share_95(hits: int, trials: int) -> list[float]:
    """Ends of the Wilson interval, to four digits."""
    return [round(end, 4) for end in wilson_interval(hits, trials)]


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


def mcnemar_exact(one: BoolArray, other: BoolArray) -> tuple[int, int, float]:
    """Episodes (n,) in which only ``one`` was good, only the ``other``, and the two-sided p of their being as many.

    Under the hypothesis each episode in which they differ is a fair coin. Source: McNemar, Psychometrika 12 (1947) 153,
    with the binomial in place of its chi-square. Raises ValueError for flags of different episodes.
    """
    one, other = _pairs(one, other)
    only_one, only_other = int((one & ~other).sum()), int((other & ~one).sum())
    differing, fewer = only_one + only_other, min(only_one, only_other)
    below = sum(comb(differing, hits) for hits in range(fewer + 1))
    return only_one, only_other, min(1.0, float(2 * below / 2**differing))


def sign_flip_exact(one: BoolArray, other: BoolArray, groups: int) -> float:
    """The two-sided p of the same hypothesis where whole groups of episodes go well or badly together.

    The episodes (n,) stand group by group, as many in each. Under the hypothesis the two methods may be exchanged in
    any group: p is the share of the 2^groups exchanges whose total difference is at least as large as what was seen,
    counted exactly. Source: Fisher, The Design of Experiments (1935), chapter 3. Raises ValueError for flags of
    different episodes, or that are no whole number of groups.
    """
    one, other = _pairs(one, other)
    if groups < 1 or len(one) % groups:
        raise ValueError(f"got {len(one)} episodes in {groups} groups, wanted as many in each")
    differences = (one.astype(int) - other.astype(int)).reshape(groups, -1).sum(1)
    sums = {0: 1}
    for size in np.abs(differences).tolist():
        following: dict[int, int] = {}
        for total, ways in sums.items():
            for signed in (total + size, total - size):
                following[signed] = following.get(signed, 0) + ways
        sums = following
    seen = abs(int(differences.sum()))
    as_far = sum(ways for total, ways in sums.items() if abs(total) >= seen)
    return float(as_far / 2**groups)


def holm(p: Sequence[float]) -> list[float]:
    """Each p as it stands next to the others: what holds for all of them together at a level holds for each that is
    below it. Source: Holm, Scandinavian Journal of Statistics 6 (1979) 65."""
    order = sorted(range(len(p)), key=lambda index: p[index])
    adjusted, least = [0.0] * len(p), 0.0
    for rank, index in enumerate(order):
        least = max(least, min(1.0, (len(p) - rank) * p[index]))
        adjusted[index] = least
    return adjusted


def _pairs(one: BoolArray, other: BoolArray) -> tuple[BoolArray, BoolArray]:
    found = np.asarray(one, dtype=bool), np.asarray(other, dtype=bool)
    if found[0].ndim != 1 or found[0].shape != found[1].shape or not len(found[0]):
        raise ValueError(f"got flags of shape {found[0].shape} and {found[1].shape}, wanted one each of every episode")
    return found


_OWN = "safedpa"


def advantages(tables: Mapping[str, Mapping[str, Mapping[str, Any]]], directions: int) -> list[dict[str, Any]]:
    """SafeDPA against every other method of each question, by outcome: safe, success, and both.

    ``tables`` by question and method. Episodes are paired by start, wind and draws. Episodes in one wind go well or
    badly together, so the exact McNemar test over episodes stands next to one that exchanges whole directions; both by
    Holm's method over all comparisons.
    """
    rows: list[dict[str, Any]] = []
    for question, methods in tables.items():
        for name, other in methods.items():
            for outcome in ("safe", "success", "both") if name != _OWN else ():
                if outcome in other:
                    pair = _flags(methods[_OWN], outcome), _flags(other, outcome)
                    more, fewer, p = mcnemar_exact(*pair)
                    found = {"only_safedpa": more, "only_other": fewer, "mcnemar": p}
                    found["directions"] = sign_flip_exact(*pair, directions)
                    rows.append({"question": question, "against": name, "outcome": outcome, **found})
    for test in ("mcnemar", "directions"):
        for row, p in zip(rows, holm([row[test] for row in rows]), strict=True):
            row[f"{test}_holm"] = p
    return rows


def _flags(row: Mapping[str, Any], outcome: str) -> Any:
    """(episodes,) from the strings of the result."""
    if outcome == "both":
        return _flags(row, "safe") & _flags(row, "success")
    return np.array([one == "1" for one in row[f"{outcome}_each"]])
