"""Checks of what comes in at run time: the answer is plain numbers or a sentence, never an exception."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import isfinite
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

__all__ = ["Plausible", "Unusable", "checked_input"]

Values = NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False)
class Plausible:
    """The range in which an input is believed, both (entries,), with the entries' names for messages."""

    low: Values
    high: Values
    names: tuple[str, ...]

    @cached_property
    def sides(self) -> tuple[tuple[float, float], ...]:
        """(low, high) of each entry, as plain numbers: a few of them are compared faster than arrays."""
        low, high = (np.broadcast_to(side, len(self.names)).tolist() for side in (self.low, self.high))
        return tuple(zip(low, high, strict=True))


@final
@dataclass(frozen=True)
class Unusable:
    """Why an input cannot be used."""

    reason: str


def checked_input(what: str, value: Any, plausible: Plausible | None) -> tuple[float, ...] | Unusable:
    """``value`` as (entries,) finite numbers within the plausible range, or why not."""
    if value is None:
        return Unusable(f"{what} is missing")
    try:
        array = np.asarray(value, dtype=np.float64)
    except Exception:  # noqa: BLE001 - whatever an object raises when it is read, it is not a vector of numbers
        return Unusable(f"{what} does not consist of numbers")
    if array.ndim != 1 or (plausible is not None and len(array) != len(plausible.names)):
        wanted = "one axis" if plausible is None else f"({len(plausible.names)},)"
        return Unusable(f"{what} has shape {array.shape}, wanted {wanted}")
    entries: tuple[float, ...] = tuple(array.tolist())
    if not all(map(isfinite, entries)):
        return Unusable(f"{what} holds NaN or infinity")
    if plausible is not None:
        for entry, (low, high), name in zip(entries, plausible.sides, plausible.names, strict=True):
            if entry < low or entry > high:
                return Unusable(f"{what} is out of its plausible range: {name} = {entry:g}, wanted {low:g} to {high:g}")
    return entries
