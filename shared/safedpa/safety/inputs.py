"""Checks of what comes in at run time: the answer is an array or a sentence, never an exception."""

from __future__ import annotations

from dataclasses import dataclass
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


@final
@dataclass(frozen=True)
class Unusable:
    """Why an input cannot be used."""

    reason: str


def checked_input(what: str, value: Any, plausible: Plausible | None) -> Values | Unusable:
    """``value`` as a fresh (entries,) array of finite numbers within the plausible range, or why not."""
    if value is None:
        return Unusable(f"{what} is missing")
    try:
        array = np.array(value, dtype=np.float64)
    except Exception:  # noqa: BLE001 - whatever an object raises when it is read, it is not a vector of numbers
        return Unusable(f"{what} does not consist of numbers")
    if array.ndim != 1 or (plausible is not None and len(array) != len(plausible.names)):
        wanted = "one axis" if plausible is None else f"({len(plausible.names)},)"
        return Unusable(f"{what} has shape {array.shape}, wanted {wanted}")
    if not np.isfinite(array).all():
        return Unusable(f"{what} holds NaN or infinity")
    if plausible is not None:
        outside = np.flatnonzero((array < plausible.low) | (array > plausible.high))
        if len(outside):
            index = int(outside[0])
            return Unusable(
                f"{what} is out of its plausible range: {plausible.names[index]} = {array[index]:g}, "
                f"wanted {plausible.low[index]:g} to {plausible.high[index]:g}"
            )
    return array
