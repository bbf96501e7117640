"""From a robot's state message to what its learned policy sees, for every kind of robot that has one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.errors import InputError, MessageError
from safedpa.policy.observation import observation_length, observe, padded
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


def _vectors(state: StateMessage, wanted: dict[str, int]) -> list[Values]:
    """Entries of the message as arrays of the right lengths."""
    vectors: list[Values] = []
    for name, length in wanted.items():
        vector = np.array(getattr(state, name), dtype=np.float64)
        if vector.shape != (length,):
            raise MessageError(f"state.{name}: got {vector.size} numbers, wanted {length}")
        vectors.append(vector)
    return vectors


def _observed_car(state: StateMessage, latent: Values) -> Values:
    lengths = {"values": 4, "applied": 2, "goal": 2, "field": 4, "footprint": 3}
    values, applied, goal, field, footprint = _vectors(state, lengths)
    if any(len(row) != 3 for row in state.obstacles):
        raise MessageError("state.obstacles: got rows of another length, wanted 3 numbers in each: x, y, radius")
    return observe(values, applied, goal, padded(state.obstacles), field, footprint, latent)


def _observed_pendulum(state: StateMessage, latent: Values) -> Values:
    values, goal = _vectors(state, {"values": 2, "goal": 1})
    return observe_pendulum(values, goal[0], latent)


_PERCEPTIONS = {
    "car": Perception(observation_length, _observed_car),
    "pendulum": Perception(pendulum_observation_length, _observed_pendulum),
}
