"""Wishes drawn at random: what a safety filter has to stand."""

from __future__ import annotations

import struct
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.dynamics import AbstractDynamics

__all__ = ["RandomWishes"]

_BOUNDS: Final = {
    "car": ((-0.6, 2.0), (-0.34, 0.34)),
    "pendulum": ((-10.0, 10.0),),
    "point": ((-0.015, 0.015), (-3.0, 3.0)),
}
"""Lowest and highest entry of each action of the robots that come with the project, in SI units: their actuators'."""


@final
class RandomWishes:
    """Uniform over the actuators' bounds, drawn anew in each tick; of other robots over the system's own bounds.

    The generator's seed is the tick with the state's bytes: so a drive in lockstep repeats, also where this process was
    started anew in between, and two robots in different states wish for different actions.
    """

    def __init__(self, model: AbstractDynamics) -> None:
        system = model.system
        bounds = _BOUNDS.get(system.name, ())
        if len(bounds) != len(system.action):
            bounds = tuple(zip(system.action_low.tolist(), system.action_high.tolist(), strict=True))
        self._low, self._high = np.array(bounds).T

    def wish(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """The action (actions,) and the controller's name; no latent is needed."""
        del latent
        count = len(state.values)
        seed = struct.unpack(f"<{2 * count}I", struct.pack(f"<{count}d", *state.values))
        drawn = np.random.default_rng([state.tick, *seed]).uniform(self._low, self._high)
        return tuple(drawn.tolist()), "random"
