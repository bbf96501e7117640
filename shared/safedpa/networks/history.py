"""The history encoder z = phi(last k states and actions)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.networks.frame import Frame, frame_of
from safedpa.networks.layers import Layer, convolution_stack, dense_stack, layers_of
from safedpa.networks.weights import STRIDE, Weights

__all__ = ["HistoryEncoder"]


_CHUNK = 16
"""Histories per batch: with twice as many, the values between the layers no longer stay in the processor's cache."""


@final
class HistoryEncoder:
    """Inference of phi: two dense layers for each row, two convolutions over time, one dense layer.

    A row is one transition: features of the state, change of state in the robot's own frame, and action, all scaled.
    Rows of zeros represent transitions before the first one. ``frame`` defaults to that of the weights' robot. Raises
    InputError if the weights have no phi.
    Source: the 1-D CNN of Kumar et al., RMA: Rapid Motor Adaptation, RSS 2021, in the sizes of SafeDPA's related code.
    """

    def __init__(self, weights: Weights, frame: Frame | None = None) -> None:
        if not weights.has("phi"):
            raise InputError("weights: no history encoder (phi) in them; train phase 2 first")
        self.length = weights.description.history
        self.latents = weights.description.latents
        self._frame = frame or frame_of(weights.description.robot)
        self._scales = [
            weights[name].astype(np.float64)
            for name in ("feature_middle", "feature_scale", "increment_scale", "action_middle", "action_scale")
        ]
        feature_middle, feature_scale, increment_scale, action_middle, action_scale = self._scales
        self._middles = np.concatenate([feature_middle, 0.0 * increment_scale, action_middle]).tolist()
        self._sizes = np.concatenate([feature_scale, increment_scale, action_scale]).tolist()
        self.row_length = sum(len(self._scales[index]) for index in (0, 2, 3))
        self.dense = layers_of(weights.tensors, "phi.dense")
        self.convolutions = layers_of(weights.tensors, "phi.conv")
        self.out = Layer(weights["phi.out.weight"], weights["phi.out.bias"])
        self.low, self.high = (weights[name].astype(np.float64) for name in ("latent_low", "latent_high"))

    def rows(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Returns n rows (..., n, row_length) for states (..., n + 1, states) and actions (..., n, actions)."""
        if states.shape[-2] != actions.shape[-2] + 1:
            raise InputError(
                f"history: got {states.shape[-2]} states and {actions.shape[-2]} actions, wanted one state more"
            )
        feature_middle, feature_scale, increment_scale, action_middle, action_scale = self._scales
        before = states[..., :-1, :]
        return np.concatenate(
            [
                (self._frame.features(before) - feature_middle) / feature_scale,
                self._frame.own_increment(before, states[..., 1:, :]) / increment_scale,
                (actions - action_middle) / action_scale,
            ],
            axis=-1,
        )

    def row_of_one(self, state: Sequence[float], action: Sequence[float], following: Sequence[float]) -> list[float]:
        """Returns the row (row_length,) of one transition, on Python floats."""
        seen = [
            *self._frame.features_of_one(state),
            *self._frame.own_increment_of_one(state, following),
            *action,
        ]
        return [(value - middle) / scale for value, middle, scale in zip(seen, self._middles, self._sizes, strict=True)]

    def padded(self, rows: FloatArray) -> FloatArray:
        """Returns the last k rows (..., k, row_length), with rows of zeros in front if there are fewer."""
        retained = rows[..., max(0, rows.shape[-2] - self.length) :, :]
        missing = self.length - retained.shape[-2]
        return np.concatenate([np.zeros((*retained.shape[:-2], missing, self.row_length)), retained], axis=-2)

    def encode(self, rows: FloatArray) -> FloatArray:
        """Returns z (..., latents) for exactly k rows (..., k, row_length), clipped to the range of the training.

        Raises InputError for any other number of rows; ``padded`` extends a shorter history.
        """
        if rows.shape[-2:] != (self.length, self.row_length):
            raise InputError(
                f"history: got {rows.shape[-2]} rows of {rows.shape[-1]}, wanted {self.length} of {self.row_length}; "
                "a history that has just begun must be padded"
            )
        flat = rows.reshape(-1, *rows.shape[-2:])
        latent = np.empty((len(flat), self.latents))
        for start in range(0, len(flat), _CHUNK):
            latent[start : start + _CHUNK] = self._encoded(flat[start : start + _CHUNK])
        # beyond the range of the training, f and g would extrapolate
        return np.clip(latent.reshape(*rows.shape[:-2], -1), self.low, self.high)

    def _encoded(self, rows: FloatArray) -> NDArray[Any]:
        """Returns z (n, latents) for histories (n, k, row_length), not clipped."""
        seen = dense_stack(rows.astype(np.float32), self.dense, "relu", last_linear=False)
        seen = convolution_stack(seen, self.convolutions, STRIDE)
        # channel by channel, as torch flattens: the weights of the last layer are in this order
        by_channel = np.swapaxes(seen, -1, -2).reshape(len(seen), -1)
        return dense_stack(by_channel, [self.out], "relu")
