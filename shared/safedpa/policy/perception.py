"""From a robot's state message to what its learned policy sees, for every kind of robot that has one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.errors import InputError, MessageError
from safedpa.policy.observation import observation_length
from safedpa.policy.one_observation import observe_one
from safedpa.policy.pendulum_observation import observe_pendulum, pendulum_observation_length

__all__ = ["Perception", "perception_of"]

Values = NDArray[np.floating[Any]]


@final
@dataclass(frozen=True)
class Perception:
    """How many numbers an observation has for so many latents, and the observation of a message with a latent."""

    length: Callable[[int], int]
    observed: Callable[[StateMessage, Values], Values]
    """Raises MessageError when something in the message has another length than the robot's."""


def perception_of(robot: str) -> Perception:
    """The perception of a kind of robot. Raises InputError when learned policies of it are not known."""
    if robot not in _PERCEPTIONS:
        raise InputError(f"robot: got '{robot}', wanted one with learned policies: {', '.join(_PERCEPTIONS)}")
    return _PERCEPTIONS[robot]


def _checked(state: StateMessage, **lengths: int) -> None:
    """Raises MessageError when an entry of the message has another length than the robot's."""
    for name, length in lengths.items():
        if len(getattr(state, name)) != length:
            raise MessageError(f"state.{name}: got {len(getattr(state, name))} numbers, wanted {length}")


def _observed_car(state: StateMessage, latent: Values) -> Values:
    _checked(state, values=4, applied=2, goal=2, field=4, footprint=3)
    if any(len(row) != 3 for row in state.obstacles):
        raise MessageError("state.obstacles: got rows of another length, wanted 3 numbers in each: x, y, radius")
    try:
        seen = observe_one(
            state.values, state.applied, state.goal, state.obstacles, state.field, state.footprint, latent.tolist()
        )
    except (ValueError, OverflowError) as error:
        raise MessageError(f"state: got numbers that are not finite in {state.values}, wanted finite ones") from error
    return np.array(seen)


def _observed_pendulum(state: StateMessage, latent: Values) -> Values:
    _checked(state, values=2, goal=1)
    return observe_pendulum(np.array(state.values), np.array(state.goal)[0], latent)


_PERCEPTIONS = {
    "car": Perception(observation_length, _observed_car),
    "pendulum": Perception(pendulum_observation_length, _observed_pendulum),
}
