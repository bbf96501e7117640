"""The constants of the theory's bound: Lipschitz constants of the networks, and errors measured in a simulator.

Lipschitz constants of ReLU networks in some of their inputs: a certain upper bound, and what samples reach.

Inputs in the 1-norm, outputs in the sup norm: the constant is the largest |d(y_i)/d(z_k)| that occurs anywhere.

The constants of the theory's bound, measured where the truth is known: a simulator in which one state is left twice.

From the same state and environment several actions are taken. Least squares over them give the true step's own F*, G*
and the part r that is not affine in the action.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.networks import Layer, LearnedNetworks, frame_of
from safedpa.networks.layers import layers_of
from safedpa.safety.margins.conformal import split_conformal_margin
from safedpa_lab.theory.bound import ErrorConstants


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


_MEASURED = ("f", "g", "remainder", "latent")


@final
@dataclass(frozen=True)
class Branches:
    """n states that were each left with k actions. Raises InputError for shapes that do not fit."""

    state: FloatArray
    """(n, states)."""
    latent: FloatArray
    """(n, latents) z = mu(e)."""
    deployed: FloatArray
    """(n, latents) z^ = phi(history)."""
    action: FloatArray
    """(n, k, actions) in SI units."""
    following: FloatArray
    """(n, k, states)."""

    def __post_init__(self) -> None:
        n, k = self.action.shape[:2]
        wanted = {"state": (n,), "latent": (n,), "deployed": self.latent.shape, "following": (n, k)}
        for name, shape in wanted.items():
            if (got := getattr(self, name).shape)[: len(shape)] != shape or n == 0:
                raise InputError(f"branches: {name} has shape {got}, wanted {shape} first, as action has; n > 0")


def affine_parts(action: FloatArray, increment: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """F* (n, states), G* (n, states, actions) and |r|_sup (n,) of increments = F* + G* u + r, by least squares over k.

    ``action`` u (n, k, actions), ``increment`` (n, k, states). Raises InputError when the actions do not tell F* and G*
    apart, or leave nothing to see r by: at least actions + 2 of them, in general position.
    """
    n, k, actions = action.shape
    table = np.concatenate([np.ones((n, k, 1)), action], axis=-1)
    if k < actions + 2 or (np.linalg.matrix_rank(table) <= actions).any():
        raise InputError(f"actions: got {k} from each state, wanted at least {actions + 2} that point all ways")
    found = np.linalg.pinv(table) @ increment
    remainder = np.abs(increment - table @ found).max(axis=(1, 2))
    return found[:, 0], np.swapaxes(found[:, 1:], 1, 2), remainder


def network_parts(networks: LearnedNetworks, state: FloatArray, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
    """F (..., states) and G (..., states, actions) of the scaled increment, at states and latents (..., .)."""
    weights = networks.weights
    scale = weights["increment_scale"].astype(np.float64)
    f, g = networks.own_increment(state, latent)
    middle = g @ weights["action_middle"].astype(np.float64)
    return (f + middle) / scale, g * weights["action_scale"] / scale[:, None]


def measured_errors(networks: LearnedNetworks, branches: Branches) -> dict[str, FloatArray]:
    """One number (n,) for each state and constant (f, g, remainder, latent), and of the whole step.

    ``step`` (n, k) is |v - v^|_sup with the deployed latent, which the bound has to cover, ``effort`` (n, k) |u|_1.
    """
    weights = networks.weights
    u = (branches.action - weights["action_middle"]) / weights["action_scale"]
    own = frame_of(networks.description.robot).own_increment(branches.state[:, None], branches.following)
    v = own / weights["increment_scale"]
    f_true, g_true, remainder = affine_parts(u, v)
    f, g = network_parts(networks, branches.state, branches.latent)
    f_deployed, g_deployed = network_parts(networks, branches.state, branches.deployed)
    expected = f_deployed[:, None] + np.einsum("nsa,nka->nks", g_deployed, u)
    return {
        "f": np.abs(f_true - f).max(axis=-1),
        "g": np.abs(g_true - g).max(axis=(-2, -1)),
        "remainder": remainder,
        "latent": np.abs(branches.deployed - branches.latent).sum(axis=-1),
        "step": np.abs(v - expected).max(axis=-1),
        "effort": np.abs(u).sum(axis=-1),
    }


def lipschitz_constants(networks: LearnedNetworks, branches: Branches) -> dict[str, tuple[float, float]]:
    """(upper bound, largest slope at the samples) of F and G in z; (0, 0) for networks without a latent."""
    weights, count = networks.weights, networks.description.latents
    if not count:
        return {"f": (0.0, 0.0), "g": (0.0, 0.0)}
    features = frame_of(networks.description.robot).features(branches.state)
    scaled = (features - weights["feature_middle"]) / weights["feature_scale"]
    samples = np.concatenate([scaled, branches.deployed], axis=-1)
    inputs = range(scaled.shape[-1], scaled.shape[-1] + count)
    layers = {name: layers_of(weights.tensors, name) for name in ("f", "g")}
    return {name: (lipschitz_bound(net, inputs), largest_slope(net, samples, inputs)) for name, net in layers.items()}


def error_constants(
    errors: Mapping[str, FloatArray], lipschitz: Mapping[str, tuple[float, float]], coverage: float | None = None
) -> ErrorConstants:
    """The bound's constants: all measured ones hold at once with probability ``coverage`` in a new, like state.

    Each of the four is the split conformal quantile at 1 - (1 - coverage) / 4 (Bonferroni); without a coverage the
    largest error seen, which for n states holds with probability 1 - 4 / (n + 1). The Lipschitz constants are the upper
    bounds. Raises InputError when there are too few states for the coverage.
    """
    share = None if coverage is None else 1.0 - (1.0 - coverage) / len(_MEASURED)
    found = {
        name: float(errors[name].max()) if share is None else split_conformal_margin(errors[name], share)
        for name in _MEASURED
    }
    if not np.isfinite(list(found.values())).all():
        raise InputError(f"coverage {coverage}: got {len(errors['f'])} states, too few; draw more or ask for less")
    return ErrorConstants(**found, lipschitz_f=lipschitz["f"][0], lipschitz_g=lipschitz["g"][0])
