"""Validation of run-time inputs and of the results of user functions.

``checked_input`` returns Python floats or the reason why an input cannot be used, and never raises. ``checked_output``
converts the result of a user's function to an array of floats. ``FiniteClock`` guards a user's clock.
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


# Typed as Any: compiled code then compares identities instead of checking for subclasses.
_ARRAY: Final[Any] = np.ndarray
_SCALAR: Final[Any] = np.float64
_FLOAT: Final[Any] = np.dtype(np.float64)
_REAL: Final = "fiu"
"""Array kinds of real numbers: floats, and integers with or without a sign."""


def checked_output(what: str, value: Any) -> FloatArray:
    """Converts ``value`` to an array of floats of any shape; a copy, since a function may reuse its result.

    Accepts numbers, lists of numbers and arrays of real numbers. Raises InputError for text, booleans, complex numbers,
    objects, and masked arrays, whose masked entries NumPy would return as if they were measured.
    """
    kind = type(value)
    if kind is float or kind is _SCALAR or (kind is _ARRAY and value.dtype is _FLOAT):
        return np.array(value)
    # Before asarray, which would drop the mask.
    if isinstance(value, np.ma.MaskedArray):
        raise InputError(f"{what}: got a masked array, wanted plain numbers")
    try:
        array = np.asarray(value)
    except Exception as error:
        raise InputError(f"{what}: got {type(value).__name__}, wanted numbers") from error
    # A list [True, 1.0] becomes an array of floats, so the entries are checked as well.
    if array.dtype.kind not in _REAL or _has_non_numbers(value):
        raise InputError(f"{what}: got {kind.__name__} of {array.dtype}, wanted real numbers")
    # astype copies even if the type is right.
    return array.astype(np.float64)


def read_only(array: FloatArray) -> FloatArray:
    """A read-only view; the array itself if it is read-only already."""
    if not array.flags.writeable:
        return array
    view = array.view()
    view.flags.writeable = False
    return view


def _has_non_numbers(value: Any) -> bool:
    """Whether a list contains booleans or masked arrays, which NumPy silently converts to numbers."""
    if isinstance(value, (list, tuple)):
        return any(map(_has_non_numbers, value))
    return isinstance(value, (bool, np.bool_, np.ma.MaskedArray))


_TUPLE: Final[Any] = tuple
_LIST: Final[Any] = list
_PYTHON_FLOAT: Final[Any] = float

_ALL_PLAUSIBLE: Final = -1
"""Returned if all entries are finite and within their range."""
_NOT_FINITE: Final = -2
"""Returned if an entry is NaN or infinite."""


@final
class Plausible:
    """The plausible range of an input, ``low`` to ``high`` (entries,), with the entries' names for messages.

    A single number applies to all entries. Raises ValueError if their numbers differ, and for NaN.
    """

    def __init__(self, low: FloatArray, high: FloatArray, names: Sequence[str]) -> None:
        self.low, self.high = low, high
        self.names: tuple[str, ...] = tuple(names)
        self.low_floats: tuple[float, ...] = tuple(np.broadcast_to(low, len(self.names)).tolist())
        """As Python floats: for so few entries a loop is faster than an array comparison."""
        self.high_floats: tuple[float, ...] = tuple(np.broadcast_to(high, len(self.names)).tolist())
        # Every comparison with NaN is false, so a NaN bound would accept everything.
        if any(map(isnan, (*self.low_floats, *self.high_floats))):
            raise ValueError("plausible range: got NaN, within which everything would be believed; wanted numbers")

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy is constructed again: a compiled object cannot be created without its arguments."""
        return Plausible, (self.low, self.high, self.names)


@final
@dataclass(frozen=True)
class InvalidInput:
    """Why an input cannot be used."""

    reason: str


def checked_input(what: str, value: Any, plausible: Plausible | None) -> tuple[float, ...] | InvalidInput:
    """Returns ``value`` as (entries,) finite floats within the plausible range, or the reason why it is not valid."""
    if value is None:
        return InvalidInput(f"{what} is missing")
    entries: tuple[float, ...]
    # The two usual types first, by identity: every other type takes the slower conversion below.
    if type(value) is _ARRAY and value.dtype is _FLOAT and value.ndim == 1:
        shape, entries = value.shape, tuple(value.tolist())
    elif (type(value) is _TUPLE or type(value) is _LIST) and _all_floats(value):
        shape, entries = (len(value),), tuple(value)
    else:
        try:
            array = checked_output(what, value)
        except Exception:  # noqa: BLE001 - an object may raise anything when it is read; it is then no vector of numbers
            return InvalidInput(f"{what} does not consist of numbers")
        shape, entries = array.shape, tuple(array.tolist()) if array.ndim == 1 else ()
    if len(shape) != 1 or (plausible is not None and len(entries) != len(plausible.names)):
        wanted = "one axis" if plausible is None else f"({len(plausible.names)},)"
        return InvalidInput(f"{what} has shape {shape}, wanted {wanted}")
    # Empty bounds leave only the check for finite values.
    low: tuple[float, ...] = () if plausible is None else plausible.low_floats
    high: tuple[float, ...] = () if plausible is None else plausible.high_floats
    found = _first_implausible(entries, low, high)
    if found == _ALL_PLAUSIBLE:
        return entries
    if plausible is None or found == _NOT_FINITE:
        return InvalidInput(f"{what} holds NaN or infinity")
    notice = f"{plausible.names[found]} = {entries[found]:g}, wanted {low[found]:g} to {high[found]:g}"
    return InvalidInput(f"{what} is out of its plausible range: {notice}")


def _all_floats(values: Any) -> bool:
    """Whether a list or tuple contains floats only: the usual case, for which no array is needed."""
    for value in values:  # noqa: SIM110 - no generator for every input
        if type(value) is not _PYTHON_FLOAT:
            return False
    return True


def checked_names(names: Any) -> tuple[str, ...] | None:
    """The names in a list, tuple or set; None for anything else, or if an entry is no text."""
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


def _first_implausible(entries: tuple[float, ...], low: tuple[float, ...], high: tuple[float, ...]) -> int:
    """The index of the first entry outside ``low`` to ``high`` (both may be empty), or one of the values above."""
    # Finite values first: NaN is neither below nor above a bound.
    for value in entries:
        if value - value != 0.0:
            return _NOT_FINITE
    for index in range(len(low)):
        value = entries[index]
        if value < low[index] or value > high[index]:
            return index
    return _ALL_PLAUSIBLE


_MAX_READING = 1e15
"""s; a larger reading is refused: the difference of two readings in microseconds must be finite."""


@final
class FiniteClock:
    """Reads another clock [s]; 0 if it raises, or returns no valid time."""

    def __init__(self, clock: Callable[[], Any]) -> None:
        self._clock = clock

    def __call__(self) -> float:
        """The reading [s]."""
        try:
            now = float(self._clock())
        except Exception:  # noqa: BLE001 - a user's clock may raise anything, and the robot must still get its action
            return 0.0
        return now if -_MAX_READING <= now <= _MAX_READING else 0.0
