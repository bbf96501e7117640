"""Checks of what comes in at run time: the answer is plain numbers or a sentence, never an exception.

What a user's function returned, as an array of real numbers; whatever only looks like them is refused.

A clock that may fail: its readings are for people, and no decision depends on them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isnan
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError

__all__ = [
    "FiniteClock",
    "InvalidInput",
    "Plausible",
    "checked_input",
    "checked_names",
    "checked_output",
    "read_only",
]


_ARRAY: Final[Any] = np.ndarray
_SCALAR: Final[Any] = np.float64
_FLOAT: Final[Any] = np.dtype(np.float64)
_REAL: Final = "fiu"
"""Kinds of arrays that hold real numbers: floats and whole ones, signed or not."""


def checked_output(what: str, value: Any) -> FloatArray:
    """``value`` as an array of floats, of any shape, and of its own: a function may return one that it writes again.

    Numbers, lists of them and arrays of real numbers are believed. Raises InputError for text, booleans, complex
    numbers, objects, and masked arrays, whose masked entries numpy would hand on as if they were measured.
    """
    kind = type(value)
    if kind is float or kind is _SCALAR or (kind is _ARRAY and value.dtype is _FLOAT):
        return np.array(value)
    if isinstance(value, np.ma.MaskedArray):
        raise InputError(f"{what}: got a masked array, wanted plain numbers")
    try:
        array = np.asarray(value)
    except Exception as error:
        raise InputError(f"{what}: got {type(value).__name__}, wanted numbers") from error
    if array.dtype.kind not in _REAL or _holds_other(value):
        raise InputError(f"{what}: got {kind.__name__} of {array.dtype}, wanted real numbers")
    return array.astype(np.float64)


def read_only(array: FloatArray) -> FloatArray:
    """The same numbers as no one can write into them: the array itself where that is so already."""
    if not array.flags.writeable:
        return array
    view = array.view()
    view.flags.writeable = False
    return view


def _holds_other(value: Any) -> bool:
    """Whether a list holds booleans or masked arrays, which numpy takes for numbers next to others."""
    if isinstance(value, (list, tuple)):
        return any(map(_holds_other, value))
    return isinstance(value, (bool, np.bool_, np.ma.MaskedArray))


_TUPLE: Final[Any] = tuple
_LIST: Final[Any] = list
_PLAIN: Final[Any] = float

_BELIEVED: Final = -1
"""All entries are finite and within their range."""
_NOT_FINITE: Final = -2
"""One of them is NaN or infinite."""


@final
class Plausible:
    """The range in which an input is believed, both (entries,), with the entries' names for messages.

    One number stands for all entries; raises ValueError where the range and the names are not as many, and for NaN.
    """

    def __init__(self, low: FloatArray, high: FloatArray, names: Sequence[str]) -> None:
        self.low, self.high = low, high
        self.names: tuple[str, ...] = tuple(names)
        self.lowest: tuple[float, ...] = tuple(np.broadcast_to(low, len(self.names)).tolist())
        """As plain numbers: a few of them are compared faster than arrays."""
        self.highest: tuple[float, ...] = tuple(np.broadcast_to(high, len(self.names)).tolist())
        if any(map(isnan, (*self.lowest, *self.highest))):
            raise ValueError("plausible range: got NaN, within which everything would be believed; wanted numbers")

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy is made again: what is compiled cannot be made without its arguments."""
        return Plausible, (self.low, self.high, self.names)


@final
@dataclass(frozen=True)
class InvalidInput:
    """Why an input cannot be used."""

    reason: str


def checked_input(what: str, value: Any, plausible: Plausible | None) -> tuple[float, ...] | InvalidInput:
    """``value`` as (entries,) finite numbers within the plausible range, or why not."""
    if value is None:
        return InvalidInput(f"{what} is missing")
    entries: tuple[float, ...]
    if type(value) is _ARRAY and value.dtype is _FLOAT and value.ndim == 1:
        shape, entries = value.shape, tuple(value.tolist())
    elif (type(value) is _TUPLE or type(value) is _LIST) and _all_floats(value):
        shape, entries = (len(value),), tuple(value)
    else:
        try:
            array = checked_output(what, value)
        except Exception:  # noqa: BLE001 - whatever an object raises when it is read, it is not a vector of numbers
            return InvalidInput(f"{what} does not consist of numbers")
        shape, entries = array.shape, tuple(array.tolist()) if array.ndim == 1 else ()
    if len(shape) != 1 or (plausible is not None and len(entries) != len(plausible.names)):
        wanted = "one axis" if plausible is None else f"({len(plausible.names)},)"
        return InvalidInput(f"{what} has shape {shape}, wanted {wanted}")
    low: tuple[float, ...] = () if plausible is None else plausible.lowest
    high: tuple[float, ...] = () if plausible is None else plausible.highest
    found = _first_unbelieved(entries, low, high)
    if found == _BELIEVED:
        return entries
    if plausible is None or found == _NOT_FINITE:
        return InvalidInput(f"{what} holds NaN or infinity")
    notice = f"{plausible.names[found]} = {entries[found]:g}, wanted {low[found]:g} to {high[found]:g}"
    return InvalidInput(f"{what} is out of its plausible range: {notice}")


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


_MOST = 1e15
"""s; beyond it a reading is none: the difference of two of them in microseconds has to be finite."""


@final
class FiniteClock:
    """The readings of another clock [s]; 0 where it raises, or tells no number that can be a time."""

    def __init__(self, clock: Callable[[], Any]) -> None:
        self._clock = clock

    def __call__(self) -> float:
        """The reading [s]."""
        try:
            now = float(self._clock())
        except Exception:  # noqa: BLE001 - whatever a user's clock raises, the robot must get its action
            return 0.0
        return now if -_MOST <= now <= _MOST else 0.0
