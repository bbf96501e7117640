"""From a nominal change of the speed to the throttle that brings it about, by the model: for a car without a servo."""

from __future__ import annotations

from collections.abc import Sequence
from math import copysign, isfinite
from typing import Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import AbstractDynamics
from safedpa.errors import InputError
from safedpa.safety.barriers.stopping import Braking

__all__ = ["BrakingByThrottle", "throttle_for"]


_SPEED: Final = 3
"""Of the state x, y, yaw, speed."""
_HALVINGS: Final = 12
"""To 0.0005 of the throttle's range: finer than any motor's."""


def throttle_for(
    model: AbstractDynamics,
    state: FloatArray,
    steer: float,
    acceleration: float,
    bounds: tuple[float, float],
    latent: FloatArray | None = None,
) -> float:
    """The throttle within ``bounds`` for which the model's speed changes by ``acceleration`` [m/s2], or comes nearest.

    By halving: the acceleration grows with the throttle, with a kink at a dead zone, and actuators count as settled, so
    that a lag asks for no more than what holds in the end. ``state`` (4,), ``latent`` (latents,). Raises InputError
    where the model has no number.
    """
    low, high = bounds

    def gained(throttle: float) -> float:
        speed = float(model.step(state, np.array([throttle, steer]), latent)[_SPEED])
        if not isfinite(speed):
            raise InputError(f"model: got the speed {speed} after a throttle of {throttle:g}, wanted a finite number")
        return (speed - float(state[_SPEED])) / model.period

    if gained(0.0) == acceleration:
        return 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if gained(middle) < acceleration:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@final
class BrakingByThrottle:
    """The backup of a car with a throttle, which 0 would let roll: it brakes as the barriers count on, wheels straight.

    d|v|/dt = -min(gain |v|, deceleration), the guaranteed ability to brake. Where a state tells no speed, the last one
    that was told counts, less what was braked since: so a car whose sensor fails is stopped, and not driven backwards.
    """

    def __init__(self, model: AbstractDynamics, braking: Braking, bounds: tuple[float, float]) -> None:
        self._model, self._braking, self._bounds = model, braking, bounds
        self._latent: FloatArray | None = None
        self._state: FloatArray | None = None
        """The newest that was told, with the speed that is believed now."""

    def learn(self, latent: FloatArray | None) -> None:
        """The latent (latents,) that was used last; None: that of the model's file."""
        self._latent = latent

    def follow(self, values: Sequence[float], period: float) -> None:
        """The state of a tick; one that cannot be lets what is believed of the speed fall as braking does."""
        reported = np.array(values, dtype=np.float64)
        if len(reported) == len(self._model.system.state) and self._model.system.is_plausible(reported):
            self._state = reported
        elif self._state is not None:
            speed = float(self._state[_SPEED])
            left = max(abs(speed) - self._deceleration(speed) * period, 0.0)
            self._state[_SPEED] = copysign(left, speed)

    def remember(self, former: BrakingByThrottle) -> None:
        """Takes over what the one before it knew of the speed."""
        self._state = former._state

    def __call__(self, state: FloatArray | None) -> FloatArray:
        """The backup action (2,) at ``state`` (4,), or at the last one that was told."""
        at = self._state if state is None else state
        if at is None or at[_SPEED] == 0.0:
            return np.zeros(2)
        speed = float(at[_SPEED])
        wanted = copysign(self._deceleration(speed), -speed)
        return np.array([throttle_for(self._model, at, 0.0, wanted, self._bounds, self._latent), 0.0])

    def _deceleration(self, speed: float) -> float:
        return min(self._braking.gain * abs(speed), self._braking.deceleration)
