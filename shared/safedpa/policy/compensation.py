"""The policy's use of the latent: drive so that the loaded robot behaves as the unloaded one would.

Let v be the entry of the state that an action's entry u steers directly (the speed, for a target speed). The nominal
model, with the latent at the values of its file, would move it to v+ under the wish u. With the estimated latent z the
model says v+ = f_v(x, z) + g_v(x, z) u', so u' = (v+ - f_v) / g_v does the same with load, as far as the bounds allow.
"""

from __future__ import annotations

import contextlib
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import PhysicsModel

__all__ = ["SpeedCompensation"]

Values = NDArray[np.float64]

_NUDGE = 1e-3
"""m/s of target speed, for the slope."""
_WEAKEST = 1e-3
"""Below this sensitivity d(v+)/du the action has no hold on the speed, and the wish stays as it is."""


@final
class SpeedCompensation:
    """Replaces the target speed of a wish by the one that has the wished effect under the latent."""

    def __init__(self, model: PhysicsModel) -> None:
        self.model = model
        self._nominal = model.latent
        self._nominal_entries: list[float] = model.latent.tolist()
        self._speed = model.system.state_names.index("speed")
        self._target = model.system.action_names.index("target_speed")

    def compensated(self, state: Values, wish: Values, latent: Values) -> Values:
        """The wish (actions,) with another target speed [m/s], for state (states,) and latent (latents,)."""
        loaded, unloaded, hold = self._speeds(state, wish, latent)
        changed = wish.copy()
        if hold > _WEAKEST:
            changed[self._target] += (unloaded - loaded) / hold
        return changed

    def _speeds(self, state: Values, wish: Values, latent: Values) -> tuple[float, float, float]:
        """The speed after the wish with the load and without, and its slope over the target speed with the load.

        Three steps of the model, which are the same to the last bit on each of its roads: a run repeats itself,
        whenever the straight line of arithmetic is ready.
        """
        nudged = wish.copy()
        nudged[self._target] += _NUDGE
        step = self.model.straight(self.model.period)
        if step is not None:
            with contextlib.suppress(ValueError, ArithmeticError):  # numbers that the other road answers
                at, wished, known = state.tolist(), wish.tolist(), latent.tolist()
                loaded = step(at, wished, known, 0.0)[self._speed]
                beyond = step(at, nudged.tolist(), known, 0.0)[self._speed]
                return loaded, step(at, wished, self._nominal_entries, 0.0)[self._speed], (beyond - loaded) / _NUDGE
        memory = self.model.initial_memory(wish, latent)
        loaded = self._speed_after(state, wish, memory, latent)
        slope = (self._speed_after(state, nudged, memory, latent) - loaded) / _NUDGE
        unloaded = self._speed_after(state, wish, self.model.initial_memory(wish, self._nominal), self._nominal)
        return loaded, unloaded, slope

    def _speed_after(self, state: Values, wish: Values, memory: Any, latent: Values) -> float:
        return float(self.model.advance(state, wish, memory, latent)[0][self._speed])
