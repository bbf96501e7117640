"""Control of the false discovery rate over the robots of a fleet.

p_i = min(1, m_i Q(z_i)) with Q the upper tail of the normal distribution, z_i the gain on unseen blocks in standard
errors, and m_i the number of candidates among which the best was chosen (Bonferroni). Of n robots, the k findings with
the smallest p are accepted, with the largest k for which p_(k) <= q k / n. The expected share of false findings among
them is then at most q.

Source: Benjamini and Hochberg, Journal of the Royal Statistical Society B 57, 1995. Without an effect, gains on unseen
blocks are negative on average, so that p is conservative.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from safedpa.arrays import FloatArray

FALSE_SHARE = 0.05
"""Maximum expected share of false findings among the accepted ones."""


def upper_tail(deviate: float) -> float:
    """Returns Q(z) = erfc(z / sqrt 2) / 2."""
    return 0.5 * math.erfc(deviate / math.sqrt(2.0))


def chance(evidence: float, trials: int) -> float:
    """Returns the p-value of the best of ``trials`` candidates, at most 1; 1 without evidence."""
    return min(1.0, trials * upper_tail(evidence)) if not math.isnan(evidence) else 1.0


def believed(chances: Sequence[float], share: float = FALSE_SHARE) -> tuple[list[bool], float]:
    """Returns which of n findings are accepted, and the largest accepted p-value (0 without any)."""
    p: FloatArray = np.asarray(chances, dtype=np.float64)
    if not len(p):
        return [], 0.0
    order = np.sort(p)
    below = np.flatnonzero(order <= share * np.arange(1, len(p) + 1) / len(p))
    limit = float(order[below[-1]]) if len(below) else 0.0
    return [bool(value <= limit and len(below)) for value in p], limit
