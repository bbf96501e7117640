"""How far a robot still moves when it brakes: the stretch that obstacle and field barriers look ahead."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import final

from safedpa.errors import InputError

__all__ = ["Braking"]


@final
@dataclass(frozen=True)
class Braking:
    """Guaranteed braking of a speed servo: d|v|/dt <= -min(gain |v|, deceleration).

    ``deceleration`` b [m/s2], ``gain`` k [1/s]: what the robot can do at least, with every load. The signed stopping
    distance D(v) solves D'(v) min(k |v|, b) = |v|, D(0) = 0, so that v + d(D)/dt <= 0 while braking forward:

        |v| <= b/k:  D = v / k
        beyond:      D = sign(v) (b/k^2 + (v^2 - (b/k)^2) / (2 b))

    D is once continuously differentiable: both slopes are 1/k at |v| = b/k. Raises InputError unless both are positive.
    """

    deceleration: float
    gain: float

    def __post_init__(self) -> None:
        for name, value in (("deceleration", self.deceleration), ("gain", self.gain)):
            if not (isfinite(value) and value > 0.0):
                raise InputError(f"braking {name}: got {value}, wanted a positive finite number")

    def distance(self, speed: float) -> float:
        """D(speed) [m], with the sign of ``speed`` [m/s]."""
        size = abs(speed)
        corner = self.deceleration / self.gain
        if size <= corner:
            return speed / self.gain
        size = corner / self.gain + (size * size - corner * corner) / (2.0 * self.deceleration)
        return size if speed > 0.0 else -size

    def slope(self, speed: float) -> float:
        """d(D)/d(speed) [s] = max(1 / k, |speed| / b)."""
        slow, quick = 1.0 / self.gain, abs(speed) / self.deceleration
        return quick if quick > slow else slow
