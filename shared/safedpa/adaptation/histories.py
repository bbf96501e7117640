"""The learned adaptation of many robots that tick at the same moments."""

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
    """z (robots, latents) = phi(last k states and actions): ``HistoryEstimator`` for many.

    Each period ``see`` the states, then tell by ``acted`` what was done. ``frame`` as for
    ``HistoryEncoder``. Raises InputError for weights without phi.
    """

    def __init__(self, weights: Weights, robots: int, frame: Frame | None = None) -> None:
        self._encoder = HistoryEncoder(weights, frame)
        self._streams = HistoryStreams(self._encoder, robots)
        self._before = np.zeros((robots, len(weights.description.states)))
        self._action = np.zeros((robots, len(weights.description.actions)))
        self._seen, self._begun = np.zeros((2, robots), dtype=bool)
        """Whether a state came before, and whether an action did after it."""
        self.latent = np.zeros((robots, self._encoder.latents))
        """Of the states that were seen last."""

    def reset(self, which: NDArray[np.intp] | Sequence[int]) -> None:
        """The robots of those indices begin again: nothing is known of them."""
        self._streams.reset(np.asarray(which).tolist())
        self._seen[which] = self._begun[which] = False

    def see(self, state: FloatArray) -> FloatArray:
        """The latents at states (robots, states)."""
        rows: Any = self._encoder.rows(np.stack((self._before, state), axis=1), self._action[:, np.newaxis])[:, 0]
        rows[~self._begun] = 0.0  # as those that stand in front of every history
        self.latent = self._streams.push(rows).astype(np.float64)
        self._before, self._seen[:] = state.copy(), True
        return self.latent

    def acted(self, action: FloatArray) -> None:
        """Takes the actions (robots, actions) that act from these states on, in SI units."""
        self._action = np.asarray(action, dtype=np.float64)
        self._begun[:] = self._seen
