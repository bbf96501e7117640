"""How far a robot still moves when it brakes: the stretch that barriers of obstacles and walls look ahead."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import final

from safedpa.errors import InputError
from safedpa.operations import FLOATS, Operations, Scalar

__all__ = ["Braking", "stopping_distance"]


def stopping_distance(speed: Scalar, deceleration: Scalar, gain: Scalar, operations: Operations) -> Scalar:
    """The signed stopping distance D [m] at ``speed`` [m/s]; see ``Braking``."""
    corner, size = deceleration / gain, operations.absolute(speed)
    far = corner / gain + (size * size - corner * corner) / (2.0 * deceleration)
    return operations.where(size <= corner, speed / gain, operations.where(speed > 0.0, far, -far))


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
        return float(stopping_distance(speed, self.deceleration, self.gain, FLOATS))
