"""Lipschitz constants of ReLU networks in some of their inputs: a certain upper bound, and what samples reach.

Inputs in the 1-norm, outputs in the sup norm: the constant is the largest |d(y_i)/d(z_k)| that occurs anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.networks import Layer

__all__ = ["largest_slope", "lipschitz_bound"]


def lipschitz_bound(layers: Sequence[Layer], inputs: Sequence[int]) -> float:
    """An upper bound that holds everywhere, for y = W_n s(... s(W_1 x + b_1) ...) + b_n in the named inputs.

    s = ReLU moves no entry by more than its input, so that slopes are products W_n D_n-1 ... D_1 W_1 with diagonal D of
    zeros and ones. The least of four bounds of such a product, each of which holds:

        |W_n|_(r to sup) |W_n-1|_(r to r) ... |W_1|_(1 to r)   for r = 1, 2, sup,
        the largest entry of abs(W_n) ... abs(W_1).

    Raises InputError without layers or inputs.
    """
    weights = _weights(layers, inputs)
    if len(weights) == 1:
        return float(np.abs(weights[0]).max())
    return min(_entries(weights), *(_norms(weights, order) for order in (1, 2, np.inf)))


def largest_slope(layers: Sequence[Layer], samples: NDArray[np.floating], inputs: Sequence[int]) -> float:
    """The largest |d(y_i)/d(z_k)| at the samples (n, all inputs): a lower bound of the Lipschitz constant.

    Raises InputError without layers, inputs or samples.
    """
    if len(samples) == 0:
        raise InputError("samples: got none, wanted at least one")
    weights = _weights(layers, inputs)
    seen = np.asarray(samples, dtype=np.float64)
    slope = np.broadcast_to(weights[0], (len(seen), *weights[0].shape))
    for index, (weight, bias) in enumerate(layers[:-1]):
        seen = seen @ np.asarray(weight, dtype=np.float64).T + bias
        awake = seen > 0.0
        seen = np.where(awake, seen, 0.0)
        slope = weights[index + 1] @ (slope * awake[..., None])
    return float(np.abs(slope).max())


def _weights(layers: Sequence[Layer], inputs: Sequence[int]) -> list[FloatArray]:
    """The layers' matrices in double precision, the first one's columns of the named inputs alone."""
    if not layers or not len(inputs):
        raise InputError(f"Lipschitz constant: got {len(layers)} layers and {len(inputs)} inputs, wanted one of each")
    matrices = [np.asarray(layer.weight, dtype=np.float64) for layer in layers]
    return [matrices[0][:, list(inputs)], *matrices[1:]]


def _entries(weights: list[FloatArray]) -> float:
    product = np.abs(weights[0])
    for weight in weights[1:]:
        product = np.abs(weight) @ product
    return float(product.max())


def _norms(weights: list[FloatArray], order: float) -> float:
    dual = {1: np.inf, 2: 2, np.inf: 1}[order]
    first = np.linalg.norm(weights[0], order, axis=0).max()  # 1 to r: the largest column
    last = np.linalg.norm(weights[-1], dual, axis=1).max()  # r to sup: the largest row in the dual norm
    between = np.prod([np.linalg.norm(weight, order) for weight in weights[1:-1]])
    return float(first * between * last)
