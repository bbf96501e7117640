"""The learned policy pi(x, z) of the point robot, for batches of robots."""

from __future__ import annotations

from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.networks import Weights, dense_stack
from safedpa.networks.layers import layers_of
from safedpa_sim.point.filtering import to_task_action
from safedpa_sim.point.observation import entries_seen

_LARGEST = 10.0
"""Scaled observations are clipped to this value."""


@final
class LatentPolicy:
    """The policy a = clip(pi(o), -1, 1) over the range of commands, with observations o from ``policy_seen``.

    Raises InputError for weights without a policy, or with one for other observations.
    """

    def __init__(self, weights: Weights) -> None:
        self._layers = layers_of(weights.tensors, "policy")
        if not self._layers:
            raise InputError("weights: got no policy (policy.0.weight), wanted one; run phase 1b of 'safedpa train'")
        self._middle, self._scale = weights["observation_middle"], weights["observation_scale"]
        got, wanted = self._layers[0].weight.shape[1], entries_seen(weights.description.latents)
        if got != wanted:
            raise InputError(
                f"weights: got a policy of {got} observations, wanted {wanted}; train it with 'safedpa train point'"
            )

    def act(self, seen: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Returns actions (robots, 2) of ``PointTask`` for observations (robots, entries) from ``policy_seen``."""
        return to_task_action(self.chosen(seen))

    def chosen(self, seen: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Returns actions (robots, 2) in [-1, 1], relative to the largest thrust and turn rate."""
        scaled = ((seen - self._middle) / self._scale).clip(-_LARGEST, _LARGEST).astype(np.float32)
        return np.asarray(dense_stack(scaled, self._layers, "tanh").clip(-1.0, 1.0), dtype=np.float64)
