"""A trained policy: a network from observations to actions."""

from __future__ import annotations

from dataclasses import replace
from math import isfinite
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import AnyFloatArray
from safedpa.bus import StateMessage
from safedpa.errors import InputError, MessageError
from safedpa.networks import Weights, dense_stack
from safedpa.networks.layers import layers_of
from safedpa.policy.perception import observation_model_of

__all__ = ["LearnedPolicy"]


_BODY, _BODY_NUMBERS = "observation_body", 3
# Limit of scaled observations. Values that never occurred in training would have unbounded effects on the network.
_LARGEST = 10.0


@final
class LearnedPolicy:
    """a = action_middle + action_scale clip(pi((o - observation_middle) / observation_scale), -1, 1).

    pi consists of dense layers with tanh activations: the mean of the Gaussian trained by proximal policy optimisation
    (PPO). o is the observation of the robot's observation model. Without a latent, the policy uses the nominal one,
    that of an environment without effects. Weights with ``observation_body`` (3,) (rear, front, radius [m]) belong to a
    policy that observes this body instead of the footprint, and so does not see a towed load. Raises InputError if the
    weights have no policy, or one for other observations.
    """

    def __init__(self, weights: Weights) -> None:
        self._layers = layers_of(weights.tensors, "policy")
        if not self._layers:
            raise InputError("weights: no policy (policy.0.weight); run phase 1b of 'safedpa train'")
        latents, actions = weights.description.latents, len(weights.description.actions)
        self._perception = observation_model_of(weights.description.robot)
        wanted = (self._perception.length(latents), actions)
        got = (self._layers[0].weight.shape[1], self._layers[-1].weight.shape[0])
        if got != wanted:
            raise InputError(
                f"weights: the policy takes {got[0]} numbers and gives {got[1]}, wanted {wanted[0]} and {wanted[1]}; "
                "train it again with phase 1b of 'safedpa train'"
            )
        self._body = _body(weights)
        self._middle, self._scale = weights["observation_middle"], weights["observation_scale"]
        self._action_middle, self._action_scale = weights["action_middle"], weights["action_scale"]
        self._into = [(np.ascontiguousarray(weight.T), bias) for weight, bias in self._layers]
        self._nominal = weights["latent_nominal"].astype(np.float64) if latents else np.zeros(0)

    def act(self, observation: AnyFloatArray) -> AnyFloatArray:
        """Returns actions (..., actions) in SI units for observations (..., observations)."""
        scaled = ((observation - self._middle) / self._scale).clip(-_LARGEST, _LARGEST).astype(np.float32)
        chosen = dense_stack(scaled, self._layers, "tanh").clip(-1.0, 1.0)
        return np.asarray(self._action_middle + self._action_scale * chosen, dtype=np.float64)

    def _act_once(self, observation: AnyFloatArray) -> list[float]:
        """Same as ``act`` for one observation (observations,), with less overhead."""
        scaled = (observation - self._middle) / self._scale
        seen = np.minimum(np.maximum(scaled, -_LARGEST), _LARGEST).astype(np.float32)
        *hidden, (matrix, bias) = self._into
        for into, offset in hidden:
            seen = np.dot(seen, into)
            seen += offset
            np.tanh(seen, out=seen)
        chosen = np.minimum(np.maximum(np.dot(seen, matrix) + bias, -1.0), 1.0)
        nominal: list[float] = (self._action_middle + self._action_scale * chosen).tolist()
        return nominal

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Returns the action for a state, and the controller's name.

        Raises MessageError if the state or the latent (latents,) does not fit the policy.
        """
        latent = self._nominal if latent is None else latent
        if latent.shape != self._nominal.shape:
            raise MessageError(f"latent: got {latent.size} entries, wanted {self._nominal.size}")
        seen = state if self._body is None else replace(state, footprint=self._body)
        observation = self._perception.observed(seen, latent)
        if not isfinite(observation.sum()):
            raise MessageError(f"state: {state.values} has numbers that are not finite")
        return tuple(self._act_once(observation)), "learned"


def _body(weights: Weights) -> tuple[float, ...] | None:
    """Returns (rear, front, radius) [m] that the policy observes instead of the footprint; None: the footprint."""
    if _BODY not in weights.tensors:
        return None
    body = tuple(weights[_BODY].ravel().tolist())
    if len(body) != _BODY_NUMBERS:
        raise InputError(f"weights: '{_BODY}' has {len(body)} numbers, wanted {_BODY_NUMBERS}: rear, front, radius")
    return body
