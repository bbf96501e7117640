"""What a model predicts for many robots at a moment: x[t+1] over their actions, and its slopes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import final

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.dynamics import AbstractDynamics, LearnedBase, PhysicsModel

__all__ = ["AbstractBatchPredictor", "AffineBatchPredictor", "BatchPredictor"]


class AbstractBatchPredictor(ABC):
    """The next states of robots at ``state`` (robots, states), whatever they do."""

    state: FloatArray
    affine: bool
    """Whether the slopes are the same about every action."""

    @abstractmethod
    def only(self, which: IndexArray) -> AbstractBatchPredictor:
        """Those of the robots of these indices."""

    @abstractmethod
    def next_state(self, action: FloatArray) -> FloatArray:
        """(robots, states) under ``action`` (robots, actions)."""

    @abstractmethod
    def slopes(self, around: FloatArray) -> FloatArray:
        """g (robots, states, actions) about ``around`` (robots, actions), an array of its own."""


@final
class BatchPredictor(AbstractBatchPredictor):
    """By a model of this project: networks are asked once, physics for every action."""

    def __init__(self, model: AbstractDynamics, state: FloatArray, latent: FloatArray | None) -> None:
        self._model, self.state, self._latent = model, state, latent
        self._affine: tuple[FloatArray, FloatArray] | None = None
        self.affine = isinstance(model, PhysicsModel) and isinstance(model.base, LearnedBase) and not model.effects
        if isinstance(model, PhysicsModel) and isinstance(model.base, LearnedBase) and self.affine:
            self._affine = _increments(model, model.base, state, latent)

    def only(self, which: IndexArray) -> BatchPredictor:  # noqa: D102
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

    def slopes(self, around: FloatArray) -> FloatArray:  # noqa: D102
        if self._affine is not None:
            return self._affine[1].copy()
        return np.array(self._model.affine(self.state, self._latent, around=around)[1])


def _increments(
    model: PhysicsModel, base: LearnedBase, state: FloatArray, latent: FloatArray | None
) -> tuple[FloatArray, FloatArray] | None:
    """f (robots, states) and g (robots, states, actions) over the model's own period, with the networks asked once.

    None where the latent (robots, latents) is not what the networks take: some of it may be fixed.
    """
    known = np.zeros((len(state), 0)) if latent is None else latent
    if not base.is_latent(model.latent_names) or known.shape[1] != len(model.latent_names):
        return None
    f, g = base.networks.increment(state, known)
    share = model.period / base.weights.description.period
    return state + share * f, share * g


@final
class AffineBatchPredictor(AbstractBatchPredictor):
    """x[t+1] = f + g a, ``f`` (robots, states) and ``g`` (robots, states, actions) known: of a simulator, say."""

    affine = True

    def __init__(self, state: FloatArray, f: FloatArray, g: FloatArray) -> None:
        self.state, self.f, self.g = state, f, g

    def only(self, which: IndexArray) -> AffineBatchPredictor:  # noqa: D102
        return AffineBatchPredictor(self.state[which], self.f[which], self.g[which])

    def next_state(self, action: FloatArray) -> FloatArray:  # noqa: D102
        return np.asarray(self.f + (self.g @ action[:, :, np.newaxis])[..., 0])

    def slopes(self, around: FloatArray) -> FloatArray:  # noqa: D102
        del around
        return self.g.copy()
