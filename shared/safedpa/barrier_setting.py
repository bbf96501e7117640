"""A parameter of a robot's barriers in the filter's settings."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite
from typing import Any, final

from safedpa.errors import InputError

__all__ = ["BarrierSetting"]


@final
@dataclass(frozen=True)
class BarrierSetting:
    """A numeric parameter: ``name`` is its key in a settings file, ``default`` its value if the key is missing."""

    name: str
    unit: str
    default: float
    meaning: str
    positive: bool = False
    """Whether it must be positive; otherwise it must be non-negative, or any number if ``signed``."""
    signed: bool = False
    above: str = ""
    """Name of another parameter that it must exceed."""

    def checked(self, value: Any) -> float:
        """Returns the value as a float. Raises InputError, which names the key, for an invalid value."""
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not isfinite(value):
            raise InputError(f"{self.name}: got {value!r}, wanted a finite number")
        low = -inf if self.signed else 0.0
        if value < low or (self.positive and value == 0.0):
            raise InputError(f"{self.name}: got {value}, wanted {'more than' if self.positive else 'at least'} {low}")
        return float(value)
