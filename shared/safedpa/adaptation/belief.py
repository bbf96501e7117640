"""How sure an estimate is: the covariance of a Kalman filter over a handful of parameters, as plain numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from math import sqrt
from typing import Any, final

__all__ = ["Belief"]


@final
class Belief:
    """The covariance P (latents, latents) of parameters that walk slowly.

    ``start``: variances at first, which are also the largest ones; ``drift``: what each variance grows by in a second.
    """

    def __init__(self, start: Sequence[float], drift: Sequence[float]) -> None:
        self._limit, self._drift = list(start), list(drift)
        self._places = _upper(len(start))
        self._diagonal = [self._places.index((entry, entry)) for entry in range(len(start))]
        self._covariance = [start[row] if row == column else 0.0 for row, column in self._places]
        """The upper triangle of P, row by row."""

    def variances(self) -> list[float]:
        """The diagonal of P (latents,), 0 where rounding left less."""
        return [max(self._covariance[place], 0.0) for place in self._diagonal]

    def spread(self, seconds: float) -> None:
        """P + Q seconds. Without excitation it must not grow for ever: at most to what was unknown at first."""
        covariance, excess = self._covariance, False
        for place, drift, limit in zip(self._diagonal, self._drift, self._limit, strict=True):
            covariance[place] += drift * seconds
            excess = excess or covariance[place] > limit
        if excess:
            variances = [covariance[place] for place in self._diagonal]
            shrink = [sqrt(min(1.0, limit / value)) for value, limit in zip(variances, self._limit, strict=True)]
            for place, (row, column) in enumerate(self._places):
                covariance[place] *= shrink[row] * shrink[column]

    def correct(
        self, innovation: Sequence[float], sensitivity: Sequence[Sequence[float]], noise: Sequence[float]
    ) -> tuple[list[float], float]:
        """Takes in a measurement: the correction K e of the estimate (latents,), and the surprise e' S^-1 e.

        Innovation e (states,), sensitivity H (states, latents), variances of the noise r (states,), S = H P H' + R. As
        R is diagonal, one entry after the other does the same as all at once: with u = P h, s = h' u + r,

            c <- c + u g,    P <- P - u u' / s,    surprise <- surprise + g^2 s,    g = (e - h' c) / s

        Source: Simon, Optimal State Estimation, section 6.1 (sequential Kalman filtering).
        """
        correct = _correction(len(self._limit))
        correction, self._covariance, surprise = correct(self._covariance, innovation, sensitivity, noise)
        return correction, surprise


def _upper(latents: int) -> list[tuple[int, int]]:
    return [(row, column) for row in range(latents) for column in range(row, latents)]


@cache
def _correction(latents: int) -> Callable[..., Any]:
    """The equations of ``Belief.correct`` for so many latents, written out: loops over two entries cost five times it.

    The function takes the upper triangle of P, e, H, r and gives the correction, the new triangle and the surprise.
    """
    every, places = range(latents), _upper(latents)

    def listed(letter: str, entries: Sequence[Any]) -> str:
        names = [
            f"{letter}{entry}" if isinstance(entry, int) else f"{letter}{entry[0]}_{entry[1]}" for entry in entries
        ]
        return f"[{', '.join(names)}]"

    def product(row: int) -> str:
        return " + ".join(f"p{min(row, column)}_{max(row, column)} * h{column}" for column in every)

    lines = [
        "def correction(covariance, innovation, sensitivity, noise):",
        f"    {listed('p', places)} = covariance",
        f"    {listed('c', every)} = {[0.0] * latents}",
        "    surprise = 0.0",
        f"    for e, {listed('h', every)}, r in zip(innovation, sensitivity, noise, strict=True):",
        *(f"        u{row} = {product(row)}" for row in every),
        f"        s = r + {' + '.join(f'h{entry} * u{entry}' for entry in every)}",
        f"        g = (e - {' - '.join(f'h{entry} * c{entry}' for entry in every)}) / s",
        "        surprise += g * g * s",
        *(f"        c{entry} += u{entry} * g" for entry in every),
        *(f"        p{row}_{column} -= u{row} * u{column} / s" for row, column in places),
        f"    return {listed('c', every)}, {listed('p', places)}, surprise",
    ]
    scope: dict[str, Any] = {}
    exec("\n".join(lines), scope)  # arithmetic on names of our own, nothing from outside
    made: Callable[..., Any] = scope["correction"]
    return made
