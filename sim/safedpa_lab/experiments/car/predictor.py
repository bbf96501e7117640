"""What a model predicts along a recorded drive: one step ahead, and open loop over many.

A learned model with a history encoder takes z = phi(the last k transitions); over many steps the encoder runs on what
the model itself has predicted, so that z follows the prediction. Of any other model the adaptation's estimate at the
start is held, and what the actuators remember is carried along.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.networks import HistoryEncoder
from safedpa_lab.experiments.car.drives import Drive
from safedpa_lab.experiments.car.margin import latents_along


class Predictor(Protocol):
    """Predictions of one model along one recorded drive of n transitions."""

    def one_step(self) -> FloatArray:
        """The predicted next states (n, states), from each measured state."""

    def rollouts(self, starts: Sequence[int], steps: int) -> FloatArray:
        """Open-loop states (starts, steps, states) under the actions driven, from the measured states ``starts``."""


def predictor_of(model: PhysicsModel, drive: Drive) -> Predictor:
    """The way to predict that fits the model."""
    base = model.base
    if isinstance(base, LearnedBase) and base.weights.has("phi"):
        return _WithHistory(model, HistoryEncoder(base.weights), drive)
    return _WithEstimate(model, drive)


class _WithEstimate:
    """Latents of the adaptation node (none for a model without), actuators' memory carried along."""

    def __init__(self, model: PhysicsModel, drive: Drive) -> None:
        self._model = model
        self._states, self._actions = drive.states, drive.actions
        self._latents = latents_along(model, drive)
        self._memories: list[Any] = [model.initial_memory(self._actions[0])]
        self._next: list[FloatArray] = []
        for state, action, latent in zip(self._states, self._actions, self._latents, strict=False):
            following, memory = model.advance(state, action, self._memories[-1], latent)
            self._next.append(following)
            self._memories.append(memory)

    def one_step(self) -> FloatArray:
        return np.array(self._next)

    def rollouts(self, starts: Sequence[int], steps: int) -> FloatArray:
        return np.array([self._rollout(start, steps) for start in starts])

    def _rollout(self, start: int, steps: int) -> list[FloatArray]:
        state, memory, rows = self._states[start], self._memories[start], []
        for action in self._actions[start : start + steps]:
            state, memory = self._model.advance(state, action, memory, self._latents[start])
            rows.append(state)
        return rows


class _WithHistory:
    """z from phi at every step, on measured transitions and then on predicted ones; all starts at once."""

    def __init__(self, model: PhysicsModel, encoder: HistoryEncoder, drive: Drive) -> None:
        self._model, self._encoder = model, encoder
        self._states, self._actions = drive.states, drive.actions
        self._rows = encoder.padded(encoder.rows(self._states, self._actions)[:0])  # zeros: before the first transition
        self._rows = np.concatenate([self._rows, encoder.rows(self._states, self._actions)])

    def one_step(self) -> FloatArray:
        starts = range(len(self._actions))
        return self.rollouts(starts, 1)[:, 0]

    def rollouts(self, starts: Sequence[int], steps: int) -> FloatArray:
        encoder = self._encoder
        histories = np.stack([self._rows[start : start + encoder.length] for start in starts])
        states, found = self._states[list(starts)], []
        for step in range(steps):
            actions = self._actions[[start + step for start in starts]]
            following = self._advanced(states, actions, encoder.encode(histories))
            rows = encoder.rows(np.stack([states, following], axis=1), actions[:, None])
            histories = np.concatenate([histories[:, 1:], rows], axis=1)
            states = following
            found.append(states)
        return np.stack(found, axis=1)

    def _advanced(self, states: FloatArray, actions: FloatArray, latents: FloatArray) -> FloatArray:
        memory = self._model.initial_memory(actions)
        return np.asarray(self._model.advance(states, actions, memory, latents)[0])
