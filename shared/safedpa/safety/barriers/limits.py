"""Barriers for limits of a state entry: ``SpeedBarrier``, and ``CorridorBarrier`` for an angle and its rate."""

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
    """h = (high - v, v - low) for the state entry v with this ``index``, in the unit of the entry (m/s for a speed).

    Without ``index`` it is a car's speed, and the barrier reads a car's states; with one, any entry of any state.
    Raises InputError unless low < high, both finite.

    Example:

        >>> safedpa.SpeedBarrier(-0.5, 2.0).h(np.array([0.0, 0.0, 0.0, 1.5]))
        array([0.5, 2. ])
    """

    kind = "speed"
    names = ("highest speed", "lowest speed")
    numbers = 2

    def __init__(self, low: float, high: float, index: int | None = None) -> None:
        if not (isfinite(low) and isfinite(high) and low < high):
            raise InputError(f"speed limits: got {low} to {high}, wanted finite numbers, low < high, in m/s")
        self.each = ((float(low), float(high)),)
        # The index is part of the form, not of the numbers: it selects the entry while the equation is recorded.
        self.form = (len(_CAR) - 1 if index is None else index,)
        self.reads = _CAR if index is None else ()

    @staticmethod
    def equation(given: Given, operations: Operations) -> Sequence[Scalar]:
        """The distance of the entry from its limits."""
        low, high = given.each
        entry = given.state[given.form[0]]
        return high - entry, entry - low

    @staticmethod
    def grad_bound(given: Given, operations: Operations) -> Sequence[Scalar]:
        """1 for the entry, 0 for all others."""
        # Both rows have the same absolute gradient, so one bound holds for either limit.
        return [1.0 if index == given.form[0] else 0.0 for index in range(len(given.state))]


@final
class CorridorBarrier(AbstractEquationBarrier):
    """h = (s - low, high - s) with s = x_a + time x_r: the angle in ``time`` [s] at its present rate.

    The set {h >= 0, low <= x_a <= high} is invariant while h >= 0 is enforced: d(x_a)/dt = (s - x_a) / time, so the
    angle follows s like a low-pass filter and never leaves the corridor that s is in. Affine, like the paper's p'x + q.

    ``angle`` and ``rate`` are indices of state entries; without both, those of a pendulum.
    Raises InputError unless low < high and time > 0, all finite.
    Source: the affine barrier of Cheng, Orosz, Murray, Burdick, End-to-End Safe Reinforcement Learning through Barrier
    Functions, AAAI 2019 (pendulum), with both edges free.

    Example:

        >>> safedpa.CorridorBarrier(-0.3, 0.3, 0.25).h(np.array([0.1, 0.4]))
        array([0.5, 0.1])
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
        # One item with two rows: both edges share the look-ahead s, which is then computed once.
        self.shared, self.each = (self.time,), ((self.low, self.high),)
        self.form = (0 if angle is None else angle, 1 if rate is None else rate)
        # Without indices the names are checked: the barrier then refuses a state that is no pendulum's.
        self.reads = ("angle", "rate") if angle is None and rate is None else ()

    @staticmethod
    def equation(given: Given, operations: Operations) -> Sequence[Scalar]:
        """The distance of s from both edges."""
        low, high = given.each
        angle, rate = given.form
        ahead = given.state[angle] + given.shared[0] * given.state[rate]
        return ahead - low, high - ahead
