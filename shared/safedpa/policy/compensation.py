"""The policy's use of the latent: drive so that the loaded robot behaves as the unloaded one would.

Let v be the entry of the state that an action's entry u steers directly (the speed, for a target speed). The nominal
model, with the latent at the values of its file, would move it to v+ under the wish u. With the estimated latent z the
model says v+ = f_v(x, z) + g_v(x, z) u', so u' = (v+ - f_v) / g_v does the same with load, as far as the bounds allow.
"""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import PhysicsModel

__all__ = ["SpeedCompensation"]

Values = NDArray[np.float64]

_WEAKEST = 1e-3
"""Below this sensitivity d(v+)/du the action has no hold on the speed, and the wish stays as it is."""


@final
class SpeedCompensation:
    """Replaces the target speed of a wish by the one that has the wished effect under the latent."""

    def __init__(self, model: PhysicsModel) -> None:
        self.model = model
        self._speed = model.system.state_names.index("speed")
        self._target = model.system.action_names.index("target_speed")

    def compensated(self, state: Values, wish: Values, latent: Values) -> Values:
        """The wish (actions,) with another target speed [m/s], for state (states,) and latent (latents,)."""
        nominal = self.model.step(state, wish)[self._speed]
        f, g = self.model.affine(state, latent, around=wish)
        hold = g[self._speed, self._target]
        changed = wish.copy()
        if hold > _WEAKEST:
            changed[self._target] += (nominal - f[self._speed] - g[self._speed] @ wish) / hold
        return changed
