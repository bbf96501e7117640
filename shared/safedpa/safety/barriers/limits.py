"""Limits of one entry of the state, such as the speed.

A corridor for an angle (or a position) whose rate is another entry of the state.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import final

from safedpa.equations import Given
from safedpa.errors import InputError
from safedpa.operations import Operations, Scalar
from safedpa.safety.barriers.equation import AbstractEquationBarrier

__all__ = [
    "CorridorBarrier",
    "SpeedBarrier",
]

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


@final
class CorridorBarrier(AbstractEquationBarrier):
    """h = (s - low, high - s), s = x_a + time x_r: where the angle is ``time`` [s] ahead, at its rate of now.

    The set {h >= 0, low <= x_a <= high} is invariant where h >= 0 is kept: d(x_a)/dt = (s - x_a) / time, so the angle
    follows s like a low-pass and never leaves the corridor that s is in. Affine, as the paper's p'x + q.

    ``angle`` and ``rate`` say which entries of any state these are; without either, a pendulum's.
    Raises InputError unless low < high and time > 0, all finite.
    Source: the affine barrier of Cheng, Orosz, Murray, Burdick, End-to-End Safe Reinforcement Learning through Barrier
    Functions, AAAI 2019 (pendulum), with both edges free.
    """

    kind = "corridor"
    numbers = 2

    def __init__(
        self,
        low: float,
        high: float,
        time: float,
        *,
        angle: int | None = None,
        rate: int | None = None,
        name: str = "",
    ) -> None:
        if not (isfinite(low) and isfinite(high) and low < high):
            raise InputError(f"corridor: got {low} to {high}, wanted finite low < high in rad")
        if not (isfinite(time) and time > 0.0):
            raise InputError(f"corridor: got {time} s ahead, wanted a finite time > 0")
        prefix = f"{name} " if name else ""
        self.names = (f"{prefix}lower edge", f"{prefix}upper edge")
        self.low, self.high, self.time = float(low), float(high), float(time)
        self.shared, self.each = (self.time,), ((self.low, self.high),)
        self.form = (0 if angle is None else angle, 1 if rate is None else rate)
        self.reads = ("angle", "rate") if angle is None and rate is None else ()

    @staticmethod
    def h(given: Given, operations: Operations) -> Sequence[Scalar]:
        """How far s lies within both edges."""
        low, high = given.each
        angle, rate = given.form
        ahead = given.state[angle] + given.shared[0] * given.state[rate]
        return ahead - low, high - ahead
