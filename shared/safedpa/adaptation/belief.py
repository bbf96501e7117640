"""How sure an estimate is: the covariance of a Kalman filter over a handful of parameters, as plain numbers."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import final

__all__ = ["Belief"]


@final
class Belief:
    """The covariance P (latents, latents) of parameters that walk slowly.

    ``start``: variances at first, which are also the largest ones; ``drift``: what each variance grows by in a second.
    """

    def __init__(self, start: Sequence[float], drift: Sequence[float]) -> None:
        self._limit, self._drift = list(start), list(drift)
        self._rows = [
            [variance if row == column else 0.0 for column in range(len(start))] for row, variance in enumerate(start)
        ]

    def variances(self) -> list[float]:
        """The diagonal of P (latents,), 0 where rounding left less."""
        return [max(row[index], 0.0) for index, row in enumerate(self._rows)]

    def spread(self, seconds: float) -> None:
        """P + Q seconds. Without excitation it must not grow for ever: at most to what was unknown at first."""
        rows, excess = self._rows, False
        for index, row in enumerate(rows):
            row[index] += self._drift[index] * seconds
            excess = excess or row[index] > self._limit[index]
        if excess:
            limits = zip(self.variances(), self._limit, strict=True)
            scale = [sqrt(min(1.0, limit / variance)) for variance, limit in limits]
            self._rows = [
                [value * here * there for value, there in zip(row, scale, strict=True)]
                for row, here in zip(rows, scale, strict=True)
            ]

    def correct(
        self, innovation: Sequence[float], sensitivity: Sequence[Sequence[float]], noise: Sequence[float]
    ) -> tuple[list[float], float]:
        """Takes in a measurement: the correction K e of the estimate (latents,), and the surprise e' S^-1 e.

        Innovation e (states,), sensitivity H (states, latents), variances of the noise r (states,), S = H P H' + R. As
        R is diagonal, one entry after the other does the same as all at once: with u = P h, s = h' u + r,

            correction <- correction + u (e - h' correction) / s,    P <- P - u u' / s

        Source: Simon, Optimal State Estimation, section 6.1 (sequential Kalman filtering).
        """
        rows, correction, surprise = self._rows, [0.0] * len(self._rows), 0.0
        for error, slopes, variance in zip(innovation, sensitivity, noise, strict=True):
            spread = [sum([value * slope for value, slope in zip(row, slopes, strict=True)]) for row in rows]
            for slope, moved, share in zip(slopes, correction, spread, strict=True):
                error -= slope * moved  # noqa: PLW2901  what is left of it
                variance += slope * share  # noqa: PLW2901
            gain = error / variance
            surprise += error * gain
            correction = [moved + share * gain for moved, share in zip(correction, spread, strict=True)]
            for row, share in zip(rows, spread, strict=True):
                part = share / variance
                for column, other in enumerate(spread):
                    row[column] -= part * other
        return correction, surprise
