"""Pooled evidence and pooled parameter values over the robots of a fleet.

Pooling finds effects that are too weak in each single robot. Evidence over n robots with the gains z_i on unseen blocks
in standard errors (Stouffer):

    z = sum(z_i) / sqrt(n)

Values x_i with standard deviations s_i, which differ between robots by a spread t (random effects):

    Q = sum w_i (x_i - sum(w x) / sum(w))^2,  w_i = 1 / s_i^2,   t^2 = max(0, (Q - n + 1) / (sum w - sum w^2 / sum w))
    mean = sum(v x) / sum(v),  v_i = 1 / (s_i^2 + t^2)

The false discovery rate over the robots is controlled with

    p_i = min(1, m_i Q(z_i)),

Q the upper tail of the normal distribution, z_i the gain of the best candidate, and m_i the number of candidates among
which it was chosen (Bonferroni). Of n robots, the k findings with the smallest p are accepted, with the largest k for
which p_(k) <= q k / n. The expected share of false findings among them is then at most q. Without an effect, gains on
unseen blocks are negative on average, so that p is conservative.

Sources: Stouffer et al., The American Soldier, 1949, vol. 1, p. 45; DerSimonian and Laird, Controlled Clinical Trials
7, 1986; Benjamini and Hochberg, Journal of the Royal Statistical Society B 57, 1995.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.fleet.outcome import EffectEvidence, Number, RobotOutcome

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


# Rounding error of the sum of weights, relative to it.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Pooled:
    """A parameter over several robots."""

    mean: float
    std: float
    """Standard deviation of the mean."""
    spread: float
    """Standard deviation between robots, beyond that of the estimates."""
    low: float
    high: float
    stated: float
    """Median of the robots' own standard deviations; NaN if none is known."""
    robots: int
    unit: str


@dataclass(frozen=True)
class PooledEvidence:
    """Evidence for an effect over the robots in which it was not found individually."""

    effect: str
    score: float
    """Pooled evidence in standard errors."""
    robots: int
    favourable: int
    """Number of robots with a positive gain."""
    rivals: tuple[str, ...] = ()
    """Effects with evidence that is not significantly lower: the fleet cannot distinguish them."""


def pooled_number(numbers: Sequence[Number]) -> Pooled:
    """Returns mean and spread of a parameter; an unknown deviation is replaced by the median of the known ones."""
    values = np.array([item.value for item in numbers])
    stds = np.array([item.std for item in numbers])
    known = np.isfinite(stds) & (stds > 0)
    stated = float(np.median(stds[known])) if known.any() else math.nan
    fallback = stated if known.any() else max(float(values.std()), 1e-12)
    stds = np.where(known, stds, fallback)
    weights = stds**-2
    centre = float((weights * values).sum() / weights.sum())
    surplus = float((weights * (values - centre) ** 2).sum()) - (len(values) - 1)
    size = float(weights.sum() - (weights**2).sum() / weights.sum())
    has_spread = size > _ROUNDING * float(weights.sum())  # for one robot, size is 0 except for rounding errors
    spread = math.sqrt(max(0.0, surplus / size)) if has_spread else 0.0
    shrunk = 1.0 / (stds**2 + spread**2)
    mean = float((shrunk * values).sum() / shrunk.sum())
    deviation = float(shrunk.sum() ** -0.5)
    low, high = float(values.min()), float(values.max())
    return Pooled(mean, deviation, spread, low, high, stated, len(values), numbers[0].unit)


def pooled_numbers(tried: Sequence[EffectEvidence]) -> dict[str, Pooled]:
    """Returns the pooled parameters of an effect by name."""
    names = tried[0].numbers if tried else {}
    return {name: pooled_number([item.numbers[name] for item in tried if name in item.numbers]) for name in names}


def estimates(effect: str, outcomes: Sequence[RobotOutcome]) -> dict[str, EffectEvidence]:
    """Returns each robot's evidence for an effect by name, found or not; without robots that did not try it."""
    notice = {}
    for outcome in outcomes:
        own = {item.effect: item for item in outcome.found}
        item = own.get(effect) or (outcome.last or {}).get(effect)
        if item is not None:
            notice[outcome.name] = item
    return notice


def evidence_over(outcomes: Sequence[RobotOutcome]) -> list[PooledEvidence]:
    """Returns the pooled evidence of each effect over the robots that tried it in vain, the strongest first."""
    scores: dict[str, dict[str, float]] = {}
    for outcome in outcomes:
        for name, item in (outcome.last or {}).items():
            if math.isfinite(item.score):
                scores.setdefault(name, {})[outcome.name] = item.score if _free(item) else min(item.score, 0.0)
    every = [_evidence(name, own) for name, own in scores.items()]
    every.sort(key=lambda item: -item.score)
    if not every:
        return []
    best = every[0]
    rivals = tuple(item.effect for item in every[1:] if _close(scores[best.effect], scores[item.effect]))
    return [PooledEvidence(best.effect, best.score, best.robots, best.favourable, rivals), *every[1:]]


def _free(item: EffectEvidence) -> bool:
    """Whether at least one parameter is not at a bound; parameters at their bounds are evidence against the effect."""
    return any(math.isfinite(number.std) for number in item.numbers.values())


def _evidence(effect: str, scores: Mapping[str, float]) -> PooledEvidence:
    values = np.array(list(scores.values()))
    return PooledEvidence(effect, float(values.sum() / math.sqrt(len(values))), len(values), int((values > 0).sum()))


def _close(best: Mapping[str, float], other: Mapping[str, float]) -> bool:
    """Whether the mean difference of the scores is below two standard errors, and the other effect has evidence."""
    both = [best[name] - other[name] for name in best if name in other]
    if len(both) < 2 or sum(other.values()) <= 0:
        return False
    difference = np.array(both)
    return bool(difference.mean() < 2.0 * difference.std(ddof=1) / math.sqrt(len(both)))
