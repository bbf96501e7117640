"""Numbers that a person wrote into a file or a call: what is one, and what is said where it is none."""

from __future__ import annotations

import math
from typing import Any

from safedpa.errors import InputError

__all__ = ["finite_number", "whole_number"]


def finite_number(key: str, value: Any, wanted: str = "a finite number", error: type[InputError] = InputError) -> float:
    """The value as a float. Raises ``error`` naming ``key`` for anything else, true and false among it."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise error(f"{key}: got {value!r}, wanted {wanted}")
    return float(value)


def whole_number(key: str, value: Any, wanted: str = "a whole number", error: type[InputError] = InputError) -> int:
    """The value, which is an int. Raises ``error`` naming ``key`` for anything else, true and false among it."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise error(f"{key}: got {value!r}, wanted {wanted}")
    return value
