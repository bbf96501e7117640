"""Wishes drawn at random: what a safety filter has to stand."""

from __future__ import annotations

import struct
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.dynamics import AbstractDynamics
from safedpa.robot import robots

__all__ = ["RandomWishes"]


@final
class RandomWishes:
    """Uniform over the actuators' bounds, drawn anew in each tick; of robots that declare none over the system's.

    The generator's seed is the tick with the state's bytes: so a drive in lockstep repeats, also where this process was
    started anew in between, and two robots in different states wish for different actions.
    """

    def __init__(self, model: AbstractDynamics) -> None:
        system = model.system
        robot = robots().get(system.name)
        bounds = () if robot is None else robot.wish_range
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
