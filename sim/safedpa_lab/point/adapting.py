"""The latents of many robots from what they lived through: phi over the last periods of each."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.networks import HistoryEncoder, Weights

__all__ = ["Adaptation"]

Floats = NDArray[np.float64]


@final
class Adaptation:
    """z (robots, latents) = phi(history). Each period ``see`` the states, then tell by ``acted`` what was done.

    Raises InputError for weights without phi.
    """

    def __init__(self, weights: Weights, count: int) -> None:
        self._encoder = HistoryEncoder(weights)
        self._rows = np.zeros((count, self._encoder.length, self._encoder.row_length))
        actions = len(weights.description.actions)
        self._before = np.zeros((count, len(weights.description.states)))
        self._action = np.zeros((count, actions))
        self._begun = np.zeros(count, bool)
        """Whether a state and an action came before."""
        self.latent = np.zeros((count, weights.description.latents))
        """Of the states that were seen last."""

    def reset(self, which: NDArray[np.intp]) -> None:
        """The robots of those indices begin anew: nothing is known of them."""
        self._rows[which] = 0.0
        self._begun[which] = False

    def see(self, state: Floats) -> Floats:
        """The latents at states (robots, states)."""
        pair = np.stack((self._before, state), axis=1)
        row = self._encoder.rows(pair, self._action[:, np.newaxis])
        which = np.flatnonzero(self._begun)
        self._rows[which, :-1] = self._rows[which, 1:]
        self._rows[which, -1:] = row[which]
        self._before = state.copy()
        self.latent = self._encoder.encode(self._rows)
        return self.latent

    def acted(self, action: Floats) -> None:
        """Takes the actions (robots, actions) that act from these states on, in SI units."""
        self._action = np.asarray(action, dtype=np.float64)
        self._begun[:] = True
