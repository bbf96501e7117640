"""From a robot's state message to what its learned policy sees, for every kind of robot that has one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

from safedpa.arrays import AnyFloatArray
from safedpa.bus import StateMessage
from safedpa.errors import InputError, MessageError
from safedpa.robot import robots

__all__ = ["ObservationModel", "checked_state", "observation_model_of"]


@final
@dataclass(frozen=True)
class ObservationModel:
    """How many numbers an observation has for so many latents, and the observation of a message with a latent."""

    length: Callable[[int], int]
    observed: Callable[[StateMessage, AnyFloatArray], AnyFloatArray]
    """Raises MessageError when something in the message has another length than the robot's."""


def observation_model_of(robot: str) -> ObservationModel:
    """The perception of a kind of robot. Raises InputError when learned policies of it are not known."""
    known = robots()
    found = known[robot].perception() if robot in known else None
    if found is None:
        taught = [name for name, one in known.items() if one.perception() is not None]
        raise InputError(f"robot: got '{robot}', wanted one with learned policies: {', '.join(taught)}")
    return found


def checked_state(state: StateMessage, **lengths: int) -> None:
    """Raises MessageError when an entry of the message has another length than the robot's."""
    for name, length in lengths.items():
        if len(getattr(state, name)) != length:
            raise MessageError(f"state.{name}: got {len(getattr(state, name))} numbers, wanted {length}")
