"""Checks of what comes in at run time: the answer is plain numbers or a sentence, never an exception."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isnan
from typing import Any, Final, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.numbers_returned import numbers_returned

__all__ = ["Plausible", "Unusable", "checked_input", "checked_names"]

Values: TypeAlias = NDArray[np.float64]

_TUPLE: Final[Any] = tuple
_LIST: Final[Any] = list
_PLAIN: Final[Any] = float
_ARRAY: Final[Any] = np.ndarray
_FLOAT: Final[Any] = np.dtype(np.float64)

_BELIEVED: Final = -1
"""All entries are finite and within their range."""
_NOT_FINITE: Final = -2
"""One of them is NaN or infinite."""


@final
class Plausible:
    """The range in which an input is believed, both (entries,), with the entries' names for messages.

    One number stands for all entries; raises ValueError where the range and the names are not as many, and for NaN.
    """

    def __init__(self, low: Values, high: Values, names: Sequence[str]) -> None:
        self.low, self.high = low, high
        self.names: tuple[str, ...] = tuple(names)
        self.lowest: tuple[float, ...] = tuple(np.broadcast_to(low, len(self.names)).tolist())
        """As plain numbers: a few of them are compared faster than arrays."""
        self.highest: tuple[float, ...] = tuple(np.broadcast_to(high, len(self.names)).tolist())
        if any(map(isnan, (*self.lowest, *self.highest))):
            raise ValueError("plausible range: got NaN, within which everything would be believed; wanted numbers")

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy is made anew: what is compiled cannot be made without its arguments."""
        return Plausible, (self.low, self.high, self.names)


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
    if type(value) is _ARRAY and value.dtype is _FLOAT and value.ndim == 1:
        shape, entries = value.shape, tuple(value.tolist())
    elif (type(value) is _TUPLE or type(value) is _LIST) and _all_floats(value):
        shape, entries = (len(value),), tuple(value)
    else:
        try:
            array = numbers_returned(what, value)
        except Exception:  # noqa: BLE001 - whatever an object raises when it is read, it is not a vector of numbers
            return Unusable(f"{what} does not consist of numbers")
        shape, entries = array.shape, tuple(array.tolist()) if array.ndim == 1 else ()
    if len(shape) != 1 or (plausible is not None and len(entries) != len(plausible.names)):
        wanted = "one axis" if plausible is None else f"({len(plausible.names)},)"
        return Unusable(f"{what} has shape {shape}, wanted {wanted}")
    low: tuple[float, ...] = () if plausible is None else plausible.lowest
    high: tuple[float, ...] = () if plausible is None else plausible.highest
    found = _first_unbelieved(entries, low, high)
    if found == _BELIEVED:
        return entries
    if plausible is None or found == _NOT_FINITE:
        return Unusable(f"{what} holds NaN or infinity")
    said = f"{plausible.names[found]} = {entries[found]:g}, wanted {low[found]:g} to {high[found]:g}"
    return Unusable(f"{what} is out of its plausible range: {said}")


def _all_floats(values: Any) -> bool:
    """Whether a list or tuple holds nothing but floats: the ordinary case, and no array is needed."""
    for value in values:  # noqa: SIM110 - no generator for every input
        if type(value) is not _PLAIN:
            return False
    return True


def checked_names(names: Any) -> tuple[str, ...] | None:
    """The names in a list, tuple or set; None where that is none, or holds anything but text."""
    if type(names) is _TUPLE and not names:
        return ()
    if not isinstance(names, (list, tuple, set, frozenset)):
        return None
    found: list[str] = []
    for name in names:
        if not isinstance(name, str):
            return None
        found.append(str(name))
    return tuple(found)


def _first_unbelieved(entries: tuple[float, ...], low: tuple[float, ...], high: tuple[float, ...]) -> int:
    """The place of the first entry outside ``low`` to ``high`` (none, or as many), or what stands above."""
    for value in entries:
        if value - value != 0.0:
            return _NOT_FINITE
    for index in range(len(low)):
        value = entries[index]
        if value < low[index] or value > high[index]:
            return index
    return _BELIEVED
