"""Checks of what comes in at run time: the answer is plain numbers or a sentence, never an exception."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.plain_input import BELIEVED, NOT_FINITE, first_unbelieved

__all__ = ["Plausible", "Unusable", "checked_input"]

Values = NDArray[np.float64]

_FLOAT = np.dtype(np.float64)
_NO_RANGE: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())


@final
@dataclass(frozen=True, eq=False)
class Plausible:
    """The range in which an input is believed, both (entries,), with the entries' names for messages."""

    low: Values
    high: Values
    names: tuple[str, ...]

    @cached_property
    def sides(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Low and high (entries,) as plain numbers: a few of them are compared faster than arrays."""
        low, high = (tuple(np.broadcast_to(side, len(self.names)).tolist()) for side in (self.low, self.high))
        return low, high


@final
@dataclass(frozen=True)
class Unusable:
    """Why an input cannot be used."""

    reason: str


def checked_input(what: str, value: Any, plausible: Plausible | None) -> tuple[float, ...] | Unusable:
    """``value`` as (entries,) finite numbers within the plausible range, or why not."""
    if value is None:
        return Unusable(f"{what} is missing")
    entries: tuple[float, ...]
    if type(value) is np.ndarray and value.dtype is _FLOAT and value.ndim == 1:
        shape, entries = value.shape, tuple(value.tolist())
    else:
        try:
            array = np.asarray(value, dtype=np.float64)
        except Exception:  # noqa: BLE001 - whatever an object raises when it is read, it is not a vector of numbers
            return Unusable(f"{what} does not consist of numbers")
        shape, entries = array.shape, tuple(array.tolist()) if array.ndim == 1 else ()
    if len(shape) != 1 or (plausible is not None and len(entries) != len(plausible.names)):
        wanted = "one axis" if plausible is None else f"({len(plausible.names)},)"
        return Unusable(f"{what} has shape {shape}, wanted {wanted}")
    low, high = _NO_RANGE if plausible is None else plausible.sides
    found = first_unbelieved(entries, low, high)
    if found == BELIEVED:
        return entries
    if plausible is None or found == NOT_FINITE:
        return Unusable(f"{what} holds NaN or infinity")
    said = f"{plausible.names[found]} = {entries[found]:g}, wanted {low[found]:g} to {high[found]:g}"
    return Unusable(f"{what} is out of its plausible range: {said}")
