"""From a robot's state message to what its learned policy sees, for every kind of robot that has one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.errors import InputError, MessageError
from safedpa.robot import robots

__all__ = ["Perception", "checked", "perception_of"]

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
    known = robots()
    found = known[robot].perception() if robot in known else None
    if found is None:
        taught = [name for name, one in known.items() if one.perception() is not None]
        raise InputError(f"robot: got '{robot}', wanted one with learned policies: {', '.join(taught)}")
    return found


def checked(state: StateMessage, **lengths: int) -> None:
    """Raises MessageError when an entry of the message has another length than the robot's."""
    for name, length in lengths.items():
        if len(getattr(state, name)) != length:
            raise MessageError(f"state.{name}: got {len(getattr(state, name))} numbers, wanted {length}")
