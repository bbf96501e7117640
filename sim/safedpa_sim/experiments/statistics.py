"""Intervals for shares."""

from __future__ import annotations

from math import sqrt

__all__ = ["wilson_interval"]

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
