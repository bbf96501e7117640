"""Many robots are many chances of a false alarm: which findings stand up to the size of the fleet.

p_i = min(1, m_i Q(z_i)): Q the upper tail of the normal distribution, z_i the standard errors of gain on unseen blocks,
m_i the candidates among which the best was chosen (Bonferroni). Of n robots the k with the smallest p are believed, k
the largest with p_(k) <= q k / n: at most a share q of the believed ones is expected to be false.

Source: Benjamini and Hochberg, Journal of the Royal Statistical Society B 57, 1995. Gains on unseen blocks are negative
in the mean where nothing is there, so p is too large rather than too small.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from safedpa.arrays import FloatArray

__all__ = ["FALSE_SHARE", "believed", "chance", "upper_tail"]

FALSE_SHARE = 0.05
"""Expected share of false findings among those that are believed."""


def upper_tail(deviate: float) -> float:
    """Q(z) = erfc(z / sqrt 2) / 2."""
    return 0.5 * math.erfc(deviate / math.sqrt(2.0))


def chance(evidence: float, trials: int) -> float:
    """p of the best of ``trials`` candidates, at most 1; 1 where there is no evidence."""
    return min(1.0, trials * upper_tail(evidence)) if not math.isnan(evidence) else 1.0


def believed(chances: Sequence[float], share: float = FALSE_SHARE) -> tuple[list[bool], float]:
    """Which of n findings stand, and the largest p that does (0 where none does)."""
    p: FloatArray = np.asarray(chances, dtype=np.float64)
    if not len(p):
        return [], 0.0
    order = np.sort(p)
    below = np.flatnonzero(order <= share * np.arange(1, len(p) + 1) / len(p))
    limit = float(order[below[-1]]) if len(below) else 0.0
    return [bool(value <= limit and len(below)) for value in p], limit
