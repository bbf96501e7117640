"""The learned control-affine dynamics x' = f(x, z) + g(x, z) a and the environment encoder z = mu(e)."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.networks.frame import frame_of
from safedpa.networks.layers import dense_stack, layers_of
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
        self._f, self._g, self._mu = (layers_of(weights.tensors, name) for name in ("f", "g", "mu"))
        self._feature_middle = weights["feature_middle"]
        self._feature_scale = weights["feature_scale"]
        self._action_middle = weights["action_middle"].astype(np.float64)
        self._action_scale = weights["action_scale"].astype(np.float64)
        self._increment_scale = weights["increment_scale"].astype(np.float64)
        self._slope_scale = self._increment_scale[:, None] / self._action_scale

    def own_increment(self, state: Values, latent: Values) -> tuple[Values, Values]:
        """(f, g) of the own-frame increment f + g a: f (..., states), g (..., states, actions).

        For states (..., states) and latents (..., latents), a in the action's units.
        """
        features = (self._frame.features(state) - self._feature_middle) / self._feature_scale
        shape = np.broadcast_shapes(features.shape[:-1], latent.shape[:-1])
        parts = [np.broadcast_to(part, (*shape, part.shape[-1])) for part in (features, latent)]
        seen = np.concatenate(parts, axis=-1).astype(np.float32)
        f = dense_stack(seen, self._f, "relu").astype(np.float64)
        g = dense_stack(seen, self._g, "relu").astype(np.float64).reshape(*f.shape, len(self._action_scale))
        g = g * self._increment_scale[:, None] / self._action_scale
        return f * self._increment_scale - g @ self._action_middle, g

    def increment(self, state: Values, latent: Values) -> tuple[Values, Values]:
        """(f, g) of the state's own entries' increment f + g a; shapes as in ``own_increment``."""
        if state.ndim == latent.ndim == 1:
            return self._increment_of_one(state, latent)
        f, g = self.own_increment(state, latent)
        turned = [self._frame.world_increment(state, g[..., index]) for index in range(g.shape[-1])]
        return self._frame.world_increment(state, f), np.stack(turned, axis=-1)

    def _increment_of_one(self, state: Values, latent: Values) -> tuple[Values, Values]:
        """``increment`` for one robot, in a third of the time: the filter asks for it a dozen times a tick."""
        features = (self._frame.features_of_one(state) - self._feature_middle) / self._feature_scale
        seen = np.concatenate((features, latent)).astype(np.float32)
        f = self._increment_scale * dense_stack(seen, self._f, "relu")
        g = self._slope_scale * dense_stack(seen, self._g, "relu").reshape(self._slope_scale.shape)
        turn = self._frame.world_matrix(state)
        return turn @ (f - g @ self._action_middle), turn @ g

    def encode(self, environment: Values) -> Values:
        """z = mu((e - middle) / scale), shape (..., latents), for environments e (..., entries) in SI units."""
        middle, scale = self.weights["environment_middle"], self.weights["environment_scale"]
        scaled = ((environment - middle) / scale).astype(np.float32)
        return dense_stack(scaled, self._mu, "relu").astype(np.float64)
