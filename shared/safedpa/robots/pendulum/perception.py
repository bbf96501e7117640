"""The observation of a learned pendulum policy, from arrays or from a state message."""

from __future__ import annotations

import numpy as np

from safedpa.arrays import AnyFloatArray
from safedpa.bus import StateMessage
from safedpa.policy.perception import ObservationModel, checked_state

_FAST = 10.0
"""rad/s; scale of the rate."""


def pendulum_observation_length(latents: int) -> int:
    """Returns the number of entries of an observation."""
    return 4 + latents


def observe_pendulum(state: AnyFloatArray, goal: AnyFloatArray, latent: AnyFloatArray) -> AnyFloatArray:
    """Returns observations (..., 4 + latents): cosine and sine of the angle, rate / 10, (goal - angle) / pi, latent.

    State (..., 2) and goal (...,) [rad] are not wrapped, so that the sign of goal - angle is the direction to turn,
    even if the goal is a full turn away.
    """
    angle, rate = state[..., 0], state[..., 1]
    own = np.stack((np.cos(angle), np.sin(angle), rate / _FAST, (goal - angle) / np.pi), axis=-1)
    return np.concatenate((own, latent), axis=-1)


def _observed_pendulum(state: StateMessage, latent: AnyFloatArray) -> AnyFloatArray:
    checked_state(state, values=2, goal=1)
    return observe_pendulum(np.array(state.values), np.array(state.goal)[0], latent)


PERCEPTION = ObservationModel(pendulum_observation_length, _observed_pendulum)
