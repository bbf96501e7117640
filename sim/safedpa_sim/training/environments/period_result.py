"""The result of one period for a batch of robots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from safedpa.arrays import BoolArray, Float32Array

__all__ = ["PeriodResult"]


@final
@dataclass(frozen=True)
class PeriodResult:
    """Arrays (robots,); an episode ends when it has ``reached`` its goal or has ``timed_out``."""

    reward: Float32Array
    reached: BoolArray
    timed_out: BoolArray
    contact: BoolArray
    """Whether the robot violates its constraint: it touches something or is in a hazard."""
    began: BoolArray
    """Whether the contact began in this tick."""
