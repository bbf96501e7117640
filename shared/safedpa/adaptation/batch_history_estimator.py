"""The learned estimator for a batch of robots with common ticks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.networks import Frame, HistoryEncoder, HistoryStreams, Weights

__all__ = ["BatchHistoryEstimator"]


@final
class BatchHistoryEstimator:
    """Computes z (robots, latents) = phi(last k states and actions); the batch version of ``HistoryEstimator``.

    In each period, call ``see`` with the states, then ``acted`` with the actions. ``frame`` is as for
    ``HistoryEncoder``. Raises InputError for weights without phi.
    """

    def __init__(self, weights: Weights, robots: int, frame: Frame | None = None) -> None:
        self._encoder = HistoryEncoder(weights, frame)
        self._streams = HistoryStreams(self._encoder, robots)
        self._before = np.zeros((robots, len(weights.description.states)))
        self._action = np.zeros((robots, len(weights.description.actions)))
        self._seen, self._begun = np.zeros((2, robots), dtype=bool)
        """Whether there was a previous state, and an action after it."""
        self.latent = np.zeros((robots, self._encoder.latents))
        """Latents at the newest states."""

    def reset(self, which: NDArray[np.intp] | Sequence[int]) -> None:
        """Clears the histories of the robots with these indices."""
        self._streams.reset(np.asarray(which).tolist())
        self._seen[which] = self._begun[which] = False

    def see(self, state: FloatArray) -> FloatArray:
        """Returns the latents at states (robots, states)."""
        rows: Any = self._encoder.rows(np.stack((self._before, state), axis=1), self._action[:, np.newaxis])[:, 0]
        rows[~self._begun] = 0.0  # the padding of an incomplete history, as in training
        self.latent = self._streams.push(rows).astype(np.float64)
        self._before, self._seen[:] = state.copy(), True
        return self.latent

    def acted(self, action: FloatArray) -> None:
        """Sets the actions (robots, actions) applied from these states on, in SI units."""
        self._action = np.asarray(action, dtype=np.float64)
        self._begun[:] = self._seen
