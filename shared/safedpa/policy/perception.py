"""Observations of learned policies from state messages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

from safedpa.arrays import AnyFloatArray
from safedpa.bus import StateMessage
from safedpa.errors import InputError, MessageError
from safedpa.systems.robots import robots

__all__ = ["ObservationModel", "checked_state", "observation_model_of"]


@final
@dataclass(frozen=True)
class ObservationModel:
    """The observations of one kind of robot."""

    length: Callable[[int], int]
    """Number of entries of an observation by the number of latents."""
    observed: Callable[[StateMessage, AnyFloatArray], AnyFloatArray]
    """(state, latent) -> observation. Raises MessageError for a message with lengths of another robot."""


def observation_model_of(robot: str) -> ObservationModel:
    """Returns the observation model of a kind of robot. Raises InputError if it has no learned policies."""
    known = robots()
    found: ObservationModel | None = known[robot].perception() if robot in known else None
    if found is None:
        taught = [name for name, one in known.items() if one.perception() is not None]
        raise InputError(f"robot: got '{robot}', wanted one with learned policies: {', '.join(taught)}")
    return found


def checked_state(state: StateMessage, **lengths: int) -> None:
    """Raises MessageError if a field of the message has another length than ``lengths`` says."""
    for name, length in lengths.items():
        if len(getattr(state, name)) != length:
            raise MessageError(f"state.{name}: got {len(getattr(state, name))} numbers, wanted {length}")
