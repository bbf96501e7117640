"""What a user's function returned, as an array of real numbers; whatever only looks like them is refused."""

from __future__ import annotations

from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError

__all__ = ["numbers_returned", "read_only"]

Values: TypeAlias = NDArray[np.float64]

_ARRAY: Final[Any] = np.ndarray
_SCALAR: Final[Any] = np.float64
_FLOAT: Final[Any] = np.dtype(np.float64)
_REAL: Final = "fiu"
"""Kinds of arrays that hold real numbers: floats and whole ones, signed or not."""


def numbers_returned(what: str, value: Any) -> Values:
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


def read_only(array: Values) -> Values:
    """The same numbers as nobody can write into them: the array itself where that is so already."""
    if not array.flags.writeable:
        return array
    view = array.view()
    view.flags.writeable = False
    return view


def _holds_other(value: Any) -> bool:
    """Whether a list holds booleans or masked arrays, which numpy takes for numbers beside others."""
    if isinstance(value, (list, tuple)):
        return any(map(_holds_other, value))
    return isinstance(value, (bool, np.bool_, np.ma.MaskedArray))
