"""A number that a robot's barriers take from the filter's settings."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite
from typing import Any, final

from safedpa.errors import InputError

__all__ = ["BarrierSetting"]


@final
@dataclass(frozen=True)
class BarrierSetting:
    """``name`` is its key in a settings file, next to those of the filter; ``default`` holds where it is left out."""

    name: str
    unit: str
    default: float
    meaning: str
    positive: bool = False
    """More than 0; else 0 or more, or anything where ``signed``."""
    signed: bool = False
    above: str = ""
    """Another one that it must exceed."""

    def checked(self, value: Any) -> float:
        """The number. Raises InputError with the key, what was got and what was wanted."""
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not isfinite(value):
            raise InputError(f"{self.name}: got {value!r}, wanted a finite number")
        low = -inf if self.signed else 0.0
        if value < low or (self.positive and value == 0.0):
            raise InputError(f"{self.name}: got {value}, wanted {'more than' if self.positive else 'at least'} {low}")
        return float(value)
