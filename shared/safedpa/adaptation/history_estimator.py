"""The learned estimator: z = phi(last k states and actions)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.adaptation.abstract import AbstractEstimator, check_transition
from safedpa.arrays import FloatArray
from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.dynamics.settings import LATENT_PREFIX
from safedpa.errors import InputError
from safedpa.networks import HistoryEncoder, HistoryStreams

__all__ = ["HistoryEstimator"]


@final
class HistoryEstimator(AbstractEstimator):
    """Encodes the last k transitions; an incomplete history is padded with zeros in front.

    Free parameters of additional effects keep the values of the model file. Raises InputError for a model without a
    history encoder.
    """

    quick = True

    def __init__(self, model: PhysicsModel) -> None:
        if not isinstance(model.base, LearnedBase):
            raise InputError("model: got physics, wanted learned networks with a history encoder")
        self._encoder = HistoryEncoder(model.base.weights)
        self._history = HistoryStreams(self._encoder)
        self._period = model.period
        entries = [index for index, path in enumerate(model.latent_names) if path.startswith(f"base.{LATENT_PREFIX}")]
        if len(entries) != self._encoder.latents:
            raise InputError(
                f"model: {len(entries)} of {self._encoder.latents} entries of the latent are free, wanted all; "
                f"remove base.{LATENT_PREFIX}... from the model file"
            )
        self.latent: FloatArray = model.latent.copy()
        self._estimated = self.latent[entries[0] : entries[-1] + 1] if entries else self.latent[:0]
        """View of the entries of the networks' latent, which are contiguous."""
        self._deviations = _deviations(model, entries)

    @property
    def deviations(self) -> FloatArray:  # noqa: D102
        return self._deviations

    def update(self, state: FloatArray, action: FloatArray, next_state: FloatArray, period: float) -> None:  # noqa: D102
        check_transition(state, action, next_state, period)
        if abs(period - self._period) > 0.01 * self._period:
            raise InputError(
                f"period: got {period:g} s, the networks were trained for {self._period:g} s; use that period"
            )
        self._estimated[:] = self._remember(state, action, next_state)

    def begin_with(self, transitions: Sequence[tuple[FloatArray, FloatArray, FloatArray, float]]) -> None:
        """Encodes the whole history, so that the estimate equals that of another estimator with these networks."""
        for state, action, next_state, _ in transitions[-self._encoder.length : -1]:
            self._remember(state, action, next_state)
        super().begin_with(transitions)

    def _remember(self, state: FloatArray, action: FloatArray, next_state: FloatArray) -> NDArray[np.float32]:
        row = self._encoder.row_of_one(state.tolist(), action.tolist(), next_state.tolist())
        latent: NDArray[np.float32] = self._history.push([row])[0]
        return latent

    def forget_transient(self) -> None:
        """Starts a new history; the estimate remains until the next update."""
        self._history.reset()


def _deviations(model: PhysicsModel, entries: list[int]) -> FloatArray:
    """Returns the deviations measured in training if the weights have them, else half the range."""
    assert isinstance(model.base, LearnedBase)
    weights = model.base.weights
    spread = 0.5 * (weights["latent_high"] - weights["latent_low"])
    found = np.zeros(len(model.latent_names))
    found[entries] = weights.tensors.get("latent_deviation", spread)
    return found
