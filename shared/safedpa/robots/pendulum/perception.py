"""From a pendulum's state message to what its learned policy sees."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.policy.perception import Perception, checked
from safedpa.robots.pendulum.pendulum_observation import observe_pendulum, pendulum_observation_length

__all__ = ["PERCEPTION"]

Values = NDArray[np.floating[Any]]


def _observed_pendulum(state: StateMessage, latent: Values) -> Values:
    checked(state, values=2, goal=1)
    return observe_pendulum(np.array(state.values), np.array(state.goal)[0], latent)


PERCEPTION = Perception(pendulum_observation_length, _observed_pendulum)
