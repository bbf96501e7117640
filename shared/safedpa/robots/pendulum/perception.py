"""What a learned policy sees of a pendulum that has to reach an angle, and that from its state message."""

from __future__ import annotations

import numpy as np

from safedpa.arrays import AnyFloatArray
from safedpa.bus import StateMessage
from safedpa.policy.perception import ObservationModel, checked_state

__all__ = ["PERCEPTION", "observe_pendulum", "pendulum_observation_length"]


_FAST = 10.0
"""rad/s that count as 1."""


def pendulum_observation_length(latents: int) -> int:
    """How many numbers an observation has."""
    return 4 + latents


def observe_pendulum(state: AnyFloatArray, goal: AnyFloatArray, latent: AnyFloatArray) -> AnyFloatArray:
    """Observations (..., 4 + latents): cosine and sine of the angle, rate / 10, (goal - angle) / pi, latent.

    State (..., 2) and goal (...,) [rad] with turns counted: the way to the goal has a direction, and goes all around
    where the goal is a turn away.
    """
    angle, rate = state[..., 0], state[..., 1]
    own = np.stack((np.cos(angle), np.sin(angle), rate / _FAST, (goal - angle) / np.pi), axis=-1)
    return np.concatenate((own, latent), axis=-1)


def _observed_pendulum(state: StateMessage, latent: AnyFloatArray) -> AnyFloatArray:
    checked_state(state, values=2, goal=1)
    return observe_pendulum(np.array(state.values), np.array(state.goal)[0], latent)


PERCEPTION = ObservationModel(pendulum_observation_length, _observed_pendulum)
