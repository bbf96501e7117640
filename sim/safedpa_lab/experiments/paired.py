"""Whether one method is better than another that was given the same episodes."""

from __future__ import annotations

from collections.abc import Sequence
from math import comb

import numpy as np

from safedpa.arrays import BoolArray

__all__ = ["holm", "mcnemar_exact", "sign_flip_exact"]


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
