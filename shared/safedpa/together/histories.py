"""The learned adaptation of many robots that tick at the same moments."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.errors import InputError
from safedpa.networks import HistoryEncoder, HistoryStreams

__all__ = ["HistoriesTogether"]

Values = NDArray[np.float64]


@final
class HistoriesTogether:
    """z = phi(last k states and actions) of each robot: ``HistoryEstimator`` for many.

    Raises InputError for a model without a history encoder, or with free parameters besides the networks' latent.
    """

    def __init__(self, model: PhysicsModel, robots: int) -> None:
        if not isinstance(model.base, LearnedBase) or not model.base.weights.has("phi"):
            raise InputError("model: got one without a history encoder, wanted learned networks with phi")
        self._encoder = HistoryEncoder(model.base.weights)
        if len(model.latent) != self._encoder.latents:
            raise InputError(
                f"model: got {len(model.latent)} free parameters, wanted the {self._encoder.latents} latents alone"
            )
        self._system = model.system
        self._streams = HistoryStreams(self._encoder, robots)
        self._latent = np.tile(model.latent, (robots, 1))
        self._before: Values | None = None
        self._believed = np.zeros(robots, dtype=bool)

    def latents(self, state: Values, applied: Values) -> Values:
        """Latents (robots, latents) up to the states (robots, states), reached under the actions (robots, actions).

        A state out of the system's bounds begins its robot's history anew, and the latent stays until there is one.
        """
        within = (state >= self._system.state_low) & (state <= self._system.state_high)
        believed: NDArray[np.bool_] = np.logical_and.reduce(within, axis=1)
        learned = believed & self._believed & np.isfinite(applied).all(axis=1)
        if self._before is not None:
            now, before = (np.where(learned[:, None], values, 0.0) for values in (state, self._before))
            felt = np.where(learned[:, None], applied, 0.0)
            rows = self._encoder.rows(np.stack([before, now], axis=1), felt[:, None])[:, 0]
            found = self._streams.push(rows)
            self._latent[learned] = found[learned]
            if not learned.all():
                self._streams.reset(np.flatnonzero(~learned).tolist())
        self._before, self._believed = state.copy(), believed
        return self._latent.copy()
