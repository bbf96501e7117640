"""Numbers that carry one slope: what slopes of equations are compared with, without anything of the recorder."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from safedpa.operations import Operations

__all__ = ["DUALS", "Dual"]


@dataclass(frozen=True, eq=False)
class Dual:
    """value + slope d, d^2 = 0; ordered by their values."""

    value: float
    slope: float = 0.0

    def __add__(self, other: Any) -> Dual:
        other = dual(other)
        return Dual(self.value + other.value, self.slope + other.slope)

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.slope)

    def __pos__(self) -> Dual:
        return self

    def __sub__(self, other: Any) -> Dual:
        return self + -dual(other)

    def __rsub__(self, other: Any) -> Dual:
        return dual(other) - self

    def __mul__(self, other: Any) -> Dual:
        other = dual(other)
        return Dual(self.value * other.value, self.slope * other.value + self.value * other.slope)

    def __truediv__(self, other: Any) -> Dual:
        other = dual(other)
        value = self.value / other.value
        return Dual(value, (self.slope - value * other.slope) / other.value)

    def __rtruediv__(self, other: Any) -> Dual:
        return dual(other) / self

    def __pow__(self, exponent: float) -> Dual:
        assert exponent == 2
        return self * self

    def __lt__(self, other: Any) -> bool:
        return self.value < dual(other).value

    def __le__(self, other: Any) -> bool:
        return self.value <= dual(other).value

    def __gt__(self, other: Any) -> bool:
        return self.value > dual(other).value

    def __ge__(self, other: Any) -> bool:
        return self.value >= dual(other).value

    def __eq__(self, other: object) -> bool:
        return self.value == dual(other).value

    __hash__ = None  # type: ignore[assignment]
    __radd__, __rmul__ = __add__, __mul__


def dual(number: Any) -> Dual:
    """A plain number has no slope."""
    return number if isinstance(number, Dual) else Dual(float(number))


def _smooth(function: Callable[[float], float], slope: Callable[[float], float]) -> Callable[[Any], Dual]:
    return lambda x: Dual(function(dual(x).value), slope(dual(x).value) * dual(x).slope)


def _hypot(x: Any, y: Any) -> Dual:
    x, y = dual(x), dual(y)
    size = math.hypot(x.value, y.value)
    return Dual(size, (x.value * x.slope + y.value * y.slope) / size if size else y.slope)


def _clip(value: Any, low: Any, high: Any) -> Dual:
    if dual(value) <= low:
        return dual(low)
    return dual(high) if dual(value) >= high else dual(value)


def _absolute(x: Any) -> Dual:
    x = dual(x)
    return x if x > 0.0 else -x if x < 0.0 else Dual(0.0)


DUALS = Operations(
    sin=_smooth(math.sin, math.cos),
    cos=_smooth(math.cos, lambda x: -math.sin(x)),
    tan=_smooth(math.tan, lambda x: 1.0 / math.cos(x) ** 2),
    atan=_smooth(math.atan, lambda x: 1.0 / (1.0 + x * x)),
    tanh=_smooth(math.tanh, lambda x: 1.0 / math.cosh(x) ** 2),
    exp=_smooth(math.exp, math.exp),
    sqrt=_smooth(math.sqrt, lambda x: 0.5 / math.sqrt(x)),
    absolute=_absolute,
    sign=lambda x: Dual(float((dual(x).value > 0.0) - (dual(x).value < 0.0))),
    minimum=lambda x, y: dual(y) if dual(y) < x else dual(x),
    maximum=lambda x, y: dual(y) if dual(y) > x else dual(x),
    clip=_clip,
    where=lambda condition, yes, no: dual(yes) if condition else dual(no),
    hypot=_hypot,
)
