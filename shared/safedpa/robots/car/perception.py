"""From a car's state message to what its learned policy sees."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.errors import MessageError
from safedpa.policy.perception import Perception, checked
from safedpa.robots.car.observation import observation_length
from safedpa.robots.car.one_observation import observe_one

__all__ = ["PERCEPTION"]

Values = NDArray[np.floating[Any]]


def _observed_car(state: StateMessage, latent: Values) -> Values:
    checked(state, values=4, applied=2, goal=2, field=4, footprint=3)
    if any(len(row) != 3 for row in state.obstacles):
        raise MessageError("state.obstacles: got rows of another length, wanted 3 numbers in each: x, y, radius")
    try:
        seen = observe_one(
            state.values, state.applied, state.goal, state.obstacles, state.field, state.footprint, latent.tolist()
        )
    except (ValueError, OverflowError) as error:
        raise MessageError(f"state: got numbers that are not finite in {state.values}, wanted finite ones") from error
    return np.array(seen)


PERCEPTION = Perception(observation_length, _observed_car)
