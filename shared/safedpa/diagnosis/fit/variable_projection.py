"""Residuals and their slopes without what a window's own start explains.

With A_w = sqrt(counts) tangent / scale of window w, a column c of numbers (sqrt(counts) residual / scale, say) becomes

    c - A (A'A)^-1 A'c.

Squares of that need no reduced column: of a residual r and a start's best shift x = (A'A)^-1 A'r the part of state s is
r_s'r_s - 2 x'A_s'r_s + x'A_s'A_s x. The products A_s'A_s are made once for all scales, A_s'r_s once for each residual.

Source: Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from safedpa.arrays import FloatArray

__all__ = ["ProjectedProducts", "VariableProjection"]

_LEAST = 1e-9
"""Share of curvature that is added in every direction: a start may be seen by nothing."""
_TOGETHER = 64
"""Windows that are reduced in one go: what they need stays in the cache, which took a quarter of the time."""
_CACHED = 4
"""Scales whose inverses are kept: a fit asks for the last two again."""


@final
@dataclass(frozen=True)
class ProjectedProducts:
    """Of residuals of some models: squares (states, models) and A_s'r_s (windows, states, starts, models), both before
    they are divided by a scale."""

    squares: FloatArray
    slopes: FloatArray


@final
class VariableProjection:
    """Windows with ``counts`` (windows, compared, states) and ``tangent`` (windows, compared, states, starts)."""

    def __init__(self, counts: FloatArray, tangent: FloatArray) -> None:
        self._root = np.sqrt(counts)
        self._basis = tangent * self._root[..., None]
        self._inverses: dict[bytes, FloatArray] = {}

    @cached_property
    def _turned(self) -> FloatArray:
        """A_s' before it is divided by a scale, (windows, states, starts, compared)."""
        return np.ascontiguousarray(self._basis.transpose(0, 2, 3, 1))

    @cached_property
    def _grams(self) -> FloatArray:
        """A_s'A_s before it is divided by a scale, (windows, states, starts, starts)."""
        return np.asarray(self._turned @ self._turned.swapaxes(-1, -2))

    def reduced(self, columns: FloatArray, scale: FloatArray) -> FloatArray:
        """Columns (windows, compared, states, columns), (windows, compared * states, columns) when reduced."""
        inverse, found = self._inverse(scale), np.empty(columns.shape)
        for begin in range(0, len(columns), _TOGETHER):
            own = slice(begin, begin + _TOGETHER)
            np.multiply(columns[own], (self._root[own] / scale)[..., None], out=found[own])
            wide = found[own].reshape(len(found[own]), -1, columns.shape[-1])
            basis = (self._basis[own] / scale[:, None]).reshape(len(wide), -1, self._basis.shape[-1])
            wide -= basis @ (inverse[own] @ (basis.swapaxes(1, 2) @ wide))
        return found.reshape(len(columns), -1, columns.shape[-1])

    def products(self, residuals: FloatArray) -> ProjectedProducts:
        """Of residuals (models, windows, compared, states), once for all scales."""
        weighted = np.ascontiguousarray((residuals * self._root).transpose(1, 3, 2, 0))
        return ProjectedProducts(np.einsum("wsnm,wsnm->sm", weighted, weighted), self._turned @ weighted)

    def squares(self, products: ProjectedProducts, scale: FloatArray) -> FloatArray:
        """Sum over the windows of the reduced residuals' squares in the states' units, (states, models)."""
        right = np.einsum("wsjm,s->wjm", products.slopes, scale**-2.0)
        shift = self._inverse(scale) @ right
        bent = self._grams @ shift[:, None] - 2.0 * products.slopes
        return np.asarray(np.maximum(products.squares + np.einsum("wsjm,wjm->sm", bent, shift), 0.0))

    def _inverse(self, scale: FloatArray) -> FloatArray:
        """(A'A)^-1 of each window, (windows, starts, starts)."""
        key = scale.tobytes()
        if key not in self._inverses:
            while len(self._inverses) >= _CACHED:
                self._inverses.pop(next(iter(self._inverses)))
            gram = np.einsum("wsjk,s->wjk", self._grams, scale**-2.0)
            size = np.sqrt(np.diagonal(gram, axis1=1, axis2=2)) + 1e-30
            around = size[:, :, None] * size[:, None, :]
            self._inverses[key] = np.linalg.inv(gram / around + _LEAST * np.eye(gram.shape[1])) / around
        return self._inverses[key]
