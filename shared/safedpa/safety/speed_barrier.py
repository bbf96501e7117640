"""Limits of one entry of the state, such as the speed."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import final

from safedpa.equations import Given
from safedpa.errors import InputError
from safedpa.operations import Operations, Scalar
from safedpa.safety.equation_barrier import AbstractEquationBarrier

__all__ = ["SpeedBarrier"]

_CAR = ("x", "y", "yaw", "speed")


@final
class SpeedBarrier(AbstractEquationBarrier):
    """h = (high - v, v - low), v the entry ``index`` of the state; unit: that of the entry, m/s for a speed.

    Without ``index`` it is a car's speed, and what it reads are a car's states; with one, any entry of any state.
    Raises InputError unless low < high, both finite.
    """

    kind = "speed"
    names = ("highest speed", "lowest speed")
    numbers = 2

    def __init__(self, low: float, high: float, index: int | None = None) -> None:
        if not (isfinite(low) and isfinite(high) and low < high):
            raise InputError(f"speed limits: got {low} to {high}, wanted finite numbers, low < high, in m/s")
        self.each = ((float(low), float(high)),)
        self.form = (len(_CAR) - 1 if index is None else index,)
        self.reads = _CAR if index is None else ()

    @staticmethod
    def h(given: Given, operations: Operations) -> Sequence[Scalar]:
        """How far the entry lies within its limits."""
        low, high = given.each
        entry = given.state[given.form[0]]
        return high - entry, entry - low

    @staticmethod
    def steepest(given: Given, operations: Operations) -> Sequence[Scalar]:
        """1 over the entry."""
        return [1.0 if index == given.form[0] else 0.0 for index in range(len(given.state))]
