"""Limits of one entry of the state, such as the speed."""

from __future__ import annotations

from math import isfinite
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractBarrier

__all__ = ["SpeedBarrier"]

Values = NDArray[np.float64]

_CAR = ("x", "y", "yaw", "speed")


@final
class SpeedBarrier(AbstractBarrier):
    """h = (high - v, v - low), v the entry ``index`` of the state; unit: that of the entry, m/s for a speed.

    Without ``index`` it is a car's speed, and what it reads are a car's states; with one, any entry of any state.
    Raises InputError unless low < high, both finite.
    """

    kind = "speed"
    names = ("highest speed", "lowest speed")

    def __init__(self, low: float, high: float, index: int | None = None) -> None:
        if not (isfinite(low) and isfinite(high) and low < high):
            raise InputError(f"speed limits: got {low} to {high}, wanted finite numbers, low < high, in m/s")
        self.low, self.high = low, high
        self.index = len(_CAR) - 1 if index is None else index
        self.reads = _CAR if index is None else ()

    def values(self, state: Values) -> Values:  # noqa: D102
        speed = state[self.index]
        return np.array((self.high - speed, speed - self.low))

    def evaluate(self, state: Values) -> tuple[Values, Values]:  # noqa: D102
        gradient = np.zeros((2, len(state)))
        gradient[0, self.index], gradient[1, self.index] = -1.0, 1.0
        return self.values(state), gradient
