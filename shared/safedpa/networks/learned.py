"""The learned control-affine dynamics x' = f(x, z) + g(x, z) a and the environment encoder z = mu(e)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.networks.frame import frame_of
from safedpa.networks.layers import Layer, dense_stack, layers_of
from safedpa.networks.paired import Paired
from safedpa.networks.plain_rows import world_row
from safedpa.networks.weights import Weights

__all__ = ["LearnedNetworks"]

Values = NDArray[np.float64]


@final
class LearnedNetworks:
    """Inference of mu, f and g. With n = [(features(x) - middle) / scale, z], u = (a - action_middle) / action_scale:

        increment in the robot's own frame = increment_scale (F(n) + G(n) u)

    Source: Xiao, He, Dolan, Shi, Safe Deep Policy Adaptation, ICRA 2024, section III; own frame and scales are ours.
    """

    def __init__(self, weights: Weights) -> None:
        self.weights = weights
        self.description = weights.description
        self._frame = frame_of(weights.description.robot)
        self._mu = layers_of(weights.tensors, "mu")
        self._increments = self._paired(weights)

    def __getstate__(self) -> dict[str, Any]:
        """Buffers do not travel, nor are they shared by copies."""
        return {"weights": self.weights}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["weights"])

    def own_increment(self, state: Values, latent: Values) -> tuple[Values, Values]:
        """(f, g) of the own-frame increment f + g a: f (..., states), g (..., states, actions).

        For states (..., states) and latents (..., latents), a in the action's units.
        """
        features = self._frame.features(state)
        shape = np.broadcast_shapes(features.shape[:-1], latent.shape[:-1])
        parts = [np.broadcast_to(part, (*shape, part.shape[-1])) for part in (features, latent)]
        seen = np.concatenate(parts, axis=-1)
        found = self._increments.many(seen.reshape(-1, seen.shape[-1])).astype(np.float64)
        found = found.reshape(*shape, state.shape[-1], -1)
        return found[..., 0], found[..., 1:]

    def increment(self, state: Values, latent: Values) -> tuple[Values, Values]:
        """(f, g) of the state's own entries' increment f + g a; shapes as in ``own_increment``."""
        if state.ndim == latent.ndim == 1:
            f_of_one, g_of_one = self.increment_of_one(state.tolist(), latent.tolist())
            return np.array(f_of_one), np.array(g_of_one)
        f, g = self.own_increment(state, latent)
        turned = [self._frame.world_increment(state, g[..., index]) for index in range(g.shape[-1])]
        return self._frame.world_increment(state, f), np.stack(turned, axis=-1)

    def increment_of_one(
        self, state: Sequence[float], latent: Sequence[float]
    ) -> tuple[list[float], list[list[float]]]:
        """``increment`` for the entries of one state and one latent: f (states,), g (states, actions)."""
        row, states = self.row_of_one(state, latent), len(state)
        actions = len(row) // states - 1
        return row[:states], [row[start : start + actions] for start in range(states, len(row), actions)]

    def row_of_one(self, state: Sequence[float], latent: Sequence[float]) -> list[float]:
        """``increment_of_one`` in one row: f, then g entry by entry of the state."""
        rows = self._increments.plain_of_one((*self._frame.features_of_one(state), *latent))
        width = len(rows) // len(state)
        self._frame.turn_to_world(state, rows, width)
        return world_row(rows, width)

    def _paired(self, weights: Weights) -> Paired:
        """F and G as functions of features and latent in SI units, with a row (f, g) for each entry of the state.

        f - g action_middle and all scales are linear, so that the first and the last layers take them up.
        """
        feature, scale = weights["feature_middle"].astype(np.float64), weights["feature_scale"].astype(np.float64)
        action, reach = weights["action_middle"].astype(np.float64), weights["action_scale"].astype(np.float64)
        increment = weights["increment_scale"].astype(np.float64)
        states, actions = len(increment), len(action)
        mix = np.zeros((states, 1 + actions, states + states * actions))
        for entry in range(states):
            slopes = slice(states + entry * actions, states + (entry + 1) * actions)
            mix[entry, 0, entry] = increment[entry]
            mix[entry, 1:, slopes] = np.diag(increment[entry] / reach)
            mix[entry, 0, slopes] = -increment[entry] * action / reach
        f, g = (_unscaled(layers_of(weights.tensors, name), feature, scale) for name in ("f", "g"))
        return Paired(f, g, mix.reshape(states * (1 + actions), -1))

    def encode(self, environment: Values) -> Values:
        """z = mu((e - middle) / scale), shape (..., latents), for environments e (..., entries) in SI units."""
        middle, scale = self.weights["environment_middle"], self.weights["environment_scale"]
        scaled = ((environment - middle) / scale).astype(np.float32)
        return dense_stack(scaled, self._mu, "relu").astype(np.float64)


def _unscaled(layers: Sequence[Layer], middle: Values, scale: Values) -> list[Layer]:
    """Layers that take x instead of (x - middle) / scale as their first entries."""
    first, *others = layers
    weight = first.weight.astype(np.float64)
    weight[:, : len(scale)] /= scale
    return [Layer(weight, first.bias - weight[:, : len(scale)] @ middle), *others]
