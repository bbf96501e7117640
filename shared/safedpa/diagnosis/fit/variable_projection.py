"""Variable projection: removes from residuals and slopes what a change of each window's start explains.

With A_w = sqrt(counts) tangent / scale of window w, a column c (such as sqrt(counts) residual / scale) becomes

    c - A (A'A)^-1 A'c.

The squares do not need the reduced column. For a residual r and the best shift x = (A'A)^-1 A'r of the start, the part
of state s is r_s'r_s - 2 x'A_s'r_s + x'A_s'A_s x. The products A_s'A_s are computed once for all scales, and A_s'r_s
once for each residual.

Source: Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from safedpa.arrays import FloatArray

# Ridge, relative to the curvature: a state of the start may not be observed by any row.
_RIDGE = 1e-9
# Windows that are reduced together: their arrays stay in the CPU cache, which took a quarter of the time.
_CHUNK = 64
# Scales whose inverses are cached: a fit uses the last two again.
_CACHED = 4


@final
@dataclass(frozen=True)
class ProjectedProducts:
    """Products of the residuals of some models, before division by a scale.

    ``squares`` (states, models); ``slopes`` (windows, states, starts, models) holds A_s'r_s.
    """

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
    def _basis_transposed(self) -> FloatArray:
        """A_s' before division by a scale, (windows, states, starts, compared)."""
        return np.ascontiguousarray(self._basis.transpose(0, 2, 3, 1))

    @cached_property
    def _grams(self) -> FloatArray:
        """A_s'A_s before division by a scale, (windows, states, starts, starts)."""
        return np.asarray(self._basis_transposed @ self._basis_transposed.swapaxes(-1, -2))

    def reduced(self, columns: FloatArray, scale: FloatArray) -> FloatArray:
        """Reduces columns (windows, compared, states, columns) to (windows, compared * states, columns)."""
        inverse, found = self._inverse(scale), np.empty(columns.shape)
        for begin in range(0, len(columns), _CHUNK):
            chunk = slice(begin, begin + _CHUNK)
            np.multiply(columns[chunk], (self._root[chunk] / scale)[..., None], out=found[chunk])
            wide = found[chunk].reshape(len(found[chunk]), -1, columns.shape[-1])
            basis = (self._basis[chunk] / scale[:, None]).reshape(len(wide), -1, self._basis.shape[-1])
            wide -= basis @ (inverse[chunk] @ (basis.swapaxes(1, 2) @ wide))
        return found.reshape(len(columns), -1, columns.shape[-1])

    def products(self, residuals: FloatArray) -> ProjectedProducts:
        """Computes the products of residuals (models, windows, compared, states), which serve all scales."""
        weighted = np.ascontiguousarray((residuals * self._root).transpose(1, 3, 2, 0))
        return ProjectedProducts(np.einsum("wsnm,wsnm->sm", weighted, weighted), self._basis_transposed @ weighted)

    def squares(self, products: ProjectedProducts, scale: FloatArray) -> FloatArray:
        """Returns the sum over the windows of the reduced residuals' squares in the states' units, (states, models)."""
        right = np.einsum("wsjm,s->wjm", products.slopes, scale**-2.0)
        shift = self._inverse(scale) @ right
        correction = self._grams @ shift[:, None] - 2.0 * products.slopes
        # The difference of large products can round to slightly below zero.
        return np.asarray(np.maximum(products.squares + np.einsum("wsjm,wjm->sm", correction, shift), 0.0))

    def _inverse(self, scale: FloatArray) -> FloatArray:
        """Returns (A'A)^-1 of each window, (windows, starts, starts)."""
        key = scale.tobytes()
        if key not in self._inverses:
            while len(self._inverses) >= _CACHED:
                self._inverses.pop(next(iter(self._inverses)))
            gram = np.einsum("wsjk,s->wjk", self._grams, scale**-2.0)
            # Scaling the diagonal to 1 makes the ridge independent of the units of the states.
            size = np.sqrt(np.diagonal(gram, axis1=1, axis2=2)) + 1e-30
            outer = size[:, :, None] * size[:, None, :]
            self._inverses[key] = np.linalg.inv(gram / outer + _RIDGE * np.eye(gram.shape[1])) / outer
        return self._inverses[key]
