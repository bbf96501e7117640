"""Checks of numbers from files and function arguments."""

from __future__ import annotations

import math
from typing import Any

from safedpa.errors import InputError

__all__ = ["finite_number", "whole_number"]


def finite_number(key: str, value: Any, wanted: str = "a finite number", error: type[InputError] = InputError) -> float:
    """Returns a finite number as a float; raises ``error`` naming ``key`` for anything else, including booleans."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise error(f"{key}: got {value!r}, wanted {wanted}")
    return float(value)


def whole_number(key: str, value: Any, wanted: str = "a whole number", error: type[InputError] = InputError) -> int:
    """Returns an int; raises ``error`` naming ``key`` for anything else, including booleans."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise error(f"{key}: got {value!r}, wanted {wanted}")
    return value
