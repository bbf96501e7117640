"""The networks in torch and double precision: the reference for all fast implementations.

    f, g     ``safedpa.networks.tensors.TensorNetworks``     against  ``LearnedNetworks.increment``, one or many
    phi      ``reference_latent``                            against  ``HistoryEncoder.encode``, ``HistoryStreams.push``
    policy   ``reference_action``                            against  ``LearnedPolicy.act``

Needs torch; no service imports it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.networks.layers import Layer, layers_of
from safedpa.networks.weights import STRIDE, Weights

__all__ = ["reference_action", "reference_latent"]


_LARGEST_OBSERVATION = 10.0
"""Bound of scaled observations, as in ``safedpa.policy.learned``."""


def reference_latent(weights: Weights, rows: FloatArray) -> FloatArray:
    """Returns z = phi(rows) (n, latents) for histories (n, k, row_length), clipped to the range of the training."""
    seen = _tensor(rows)
    for layer in layers_of(weights.tensors, "phi.dense"):
        seen = torch.relu(_linear(seen, layer))
    wave = seen.swapaxes(1, 2)
    for weight, bias in layers_of(weights.tensors, "phi.conv"):
        wave = torch.relu(torch.nn.functional.conv1d(wave, _tensor(weight), _tensor(bias), stride=STRIDE))
    latent = _linear(wave.flatten(1), Layer(weights["phi.out.weight"], weights["phi.out.bias"]))
    low, high = _tensor(weights["latent_low"]), _tensor(weights["latent_high"])
    return np.asarray(torch.minimum(torch.maximum(latent, low), high).numpy())


def reference_action(weights: Weights, observation: FloatArray) -> FloatArray:
    """Returns a = middle + scale clip(pi((o - middle) / scale), -1, 1) (n, actions) for observations o (n, ...)."""
    scaled = (_tensor(observation) - _tensor(weights["observation_middle"])) / _tensor(weights["observation_scale"])
    seen = scaled.clip(-_LARGEST_OBSERVATION, _LARGEST_OBSERVATION)
    *hidden, last = layers_of(weights.tensors, "policy")
    for layer in hidden:
        seen = torch.tanh(_linear(seen, layer))
    chosen = _linear(seen, last).clip(-1.0, 1.0)
    return np.asarray((_tensor(weights["action_middle"]) + _tensor(weights["action_scale"]) * chosen).numpy())


def _linear(x: Any, layer: Layer) -> Any:
    return torch.nn.functional.linear(x, _tensor(layer.weight), _tensor(layer.bias))


def _tensor(values: NDArray[Any]) -> Any:
    return torch.from_numpy(np.asarray(values, dtype=np.float64))
