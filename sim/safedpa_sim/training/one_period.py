"""What one period brought to each of many robots that practise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from safedpa.arrays import BoolArray, Float32Array

__all__ = ["PeriodResult"]


@final
@dataclass(frozen=True)
class PeriodResult:
    """Arrays (robots,); an episode ends where ``reached`` or ``timed_out``."""

    reward: Float32Array
    reached: BoolArray
    timed_out: BoolArray
    contact: BoolArray
    """What must not be is going on: something is touched, a hazard is entered."""
    began: BoolArray
    """Contacts that began in this tick."""
