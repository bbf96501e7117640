"""The sequential test: has the error left its band for good?

In each second that the robot drives, one forecast that overlaps no other is inside its band (0), outside (1) or beyond
twice the band (2). The null hypothesis is that, whatever went before,

    P(outside or beyond | past) <= 5 %   and   P(beyond | past) <= 1 %

Then e = 1 - s + s (0, 12.5 or 50), the last factor by what happened, has a mean of at most 1 for every stake s in
[0, 1], and M[n] = (M[n-1] + 1) e[n] (Shiryaev and Roberts) is an e-detector: M[n] - n is a supermartingale. By Doob's
inequality P(M reaches 1/alpha within n seconds) <= n alpha, and a false finding is n = 1/alpha seconds away on average
at the least. No independence is assumed: that seconds of one drive resemble each other is what the 5 and 1 % leave room
for; a band learned from n forecasts is left far more seldom.

Source: Shin, Ramdas and Rinaldo, E-detectors: a nonparametric framework for sequential change detection, 2023.
"""

from __future__ import annotations

from math import exp, log
from typing import Final, final

__all__ = ["ALPHA", "BEYOND", "Evidence"]

ALPHA: Final = 1e-6
"""In an hour of driving a false finding comes with probability 0.4 % at most, in ten hours with 3.6 %."""
BEYOND: Final = 2.0
"""Times the band's edge."""

_OUTSIDE_PAYS = 0.5 / 0.04
_BEYOND_PAYS = 0.5 / 0.01
_STAKES = (0.3, 0.9)
_MOST = log(1e9)
"""Of the logarithm: more would only make it slower to see that all is well again."""


@final
class Evidence:
    """The e-detector of one robot and model."""

    def __init__(self) -> None:
        self._sums = [0.0 for _ in _STAKES]
        self._walk = 0.0
        self.since: int | None = None
        """Tick from which on the evidence has grown. None while there is none."""

    @property
    def threshold(self) -> float:
        """log(1 / alpha)"""
        return -log(ALPHA)

    @property
    def value(self) -> float:
        """log of the mean of M over the stakes; 0 at the start."""
        mean = sum(self._sums) / len(self._sums)
        return log(mean) if mean > 1.0 else 0.0

    @property
    def raised(self) -> bool:
        """Whether the null hypothesis is given up."""
        return self.value >= self.threshold

    def add(self, ratio: float, start: int) -> None:
        """Takes one forecast: its error over the band's edge, and the tick at which it began."""
        pays = _BEYOND_PAYS if ratio > BEYOND else _OUTSIDE_PAYS if ratio > 1.0 else 0.0
        factors = [1.0 - stake + stake * pays for stake in _STAKES]
        self._sums = [min((own + 1.0) * factor, exp(_MOST)) for own, factor in zip(self._sums, factors, strict=True)]
        self._walk = min(max(0.0, self._walk + log(factors[-1])), _MOST)
        if self._walk == 0.0:
            self.since = None
        elif self.since is None:
            self.since = start
