"""Predictions for many robots at one moment: x[t+1] as a function of their actions, and its derivative g."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import final

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.dynamics import AbstractDynamics, LearnedBase, PhysicsModel

__all__ = ["AbstractBatchPredictor", "AffineBatchPredictor", "BatchPredictor"]


class AbstractBatchPredictor(ABC):
    """The next states of robots at ``state`` (robots, states) for any actions."""

    state: FloatArray
    affine: bool
    """Whether g is the same for every action."""

    @abstractmethod
    def only(self, which: IndexArray) -> AbstractBatchPredictor:
        """The predictor of the robots of these indices."""

    @abstractmethod
    def next_state(self, action: FloatArray) -> FloatArray:
        """(robots, states) under ``action`` (robots, actions)."""

    @abstractmethod
    def control_matrix(self, around: FloatArray) -> FloatArray:
        """g (robots, states, actions) about ``around`` (robots, actions); a copy that the caller may change."""


@final
class BatchPredictor(AbstractBatchPredictor):
    """Predictions of a model of this project: networks are evaluated once, physics for every action."""

    def __init__(self, model: AbstractDynamics, state: FloatArray, latent: FloatArray | None) -> None:
        self._model, self.state, self._latent = model, state, latent
        self._affine: tuple[FloatArray, FloatArray] | None = None
        # Only a learned base without effects is affine by construction; an effect may saturate or bend.
        self.affine = isinstance(model, PhysicsModel) and isinstance(model.base, LearnedBase) and not model.effects
        if isinstance(model, PhysicsModel) and isinstance(model.base, LearnedBase) and self.affine:
            self._affine = _increments(model, model.base, state, latent)

    def only(self, which: IndexArray) -> BatchPredictor:  # noqa: D102
        # Without __init__, which would evaluate the networks again.
        some = object.__new__(BatchPredictor)
        some._model, some.state = self._model, self.state[which]
        some.affine = self.affine
        some._latent = None if self._latent is None else self._latent[which]
        some._affine = None if self._affine is None else (self._affine[0][which], self._affine[1][which])
        return some

    def next_state(self, action: FloatArray) -> FloatArray:  # noqa: D102
        if self._affine is not None:
            return np.asarray(self._affine[0] + (self._affine[1] @ action[:, :, np.newaxis])[..., 0])
        return np.asarray(self._model.step(self.state, action, self._latent))

    def control_matrix(self, around: FloatArray) -> FloatArray:  # noqa: D102
        if self._affine is not None:
            return self._affine[1].copy()
        return np.array(self._model.affine(self.state, self._latent, around=around)[1])


def _increments(
    model: PhysicsModel, base: LearnedBase, state: FloatArray, latent: FloatArray | None
) -> tuple[FloatArray, FloatArray] | None:
    """f (robots, states) and g (robots, states, actions) over the model's period, with one evaluation of the networks.

    None if the latent (robots, latents) is not what the networks take: some of it may be fixed.
    """
    known = np.zeros((len(state), 0)) if latent is None else latent
    # The networks were trained on their own latent: another one has the same shape but another meaning.
    if not base.is_latent(model.latent_names) or known.shape[1] != len(model.latent_names):
        return None
    f, g = base.networks.increment(state, known)
    # The networks predict the change over the period of their training; the filter may run at another one.
    share = model.period / base.weights.description.period
    return state + share * f, share * g


@final
class AffineBatchPredictor(AbstractBatchPredictor):
    """x[t+1] = f + g a with given ``f`` (robots, states) and ``g`` (robots, states, actions), such as a simulator's."""

    affine = True

    def __init__(self, state: FloatArray, f: FloatArray, g: FloatArray) -> None:
        self.state, self.f, self.g = state, f, g

    def only(self, which: IndexArray) -> AffineBatchPredictor:  # noqa: D102
        return AffineBatchPredictor(self.state[which], self.f[which], self.g[which])

    def next_state(self, action: FloatArray) -> FloatArray:  # noqa: D102
        return np.asarray(self.f + (self.g @ action[:, :, np.newaxis])[..., 0])

    def control_matrix(self, around: FloatArray) -> FloatArray:  # noqa: D102
        del around
        # The caller replaces columns of saturated actuators, which must not change the given g.
        return self.g.copy()
