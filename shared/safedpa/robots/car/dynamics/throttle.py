"""Inversion of the model for the throttle of a car without a speed servo, and its backup controller."""

from __future__ import annotations

from collections.abc import Sequence
from math import copysign, isfinite
from typing import Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import AbstractDynamics
from safedpa.errors import InputError
from safedpa.safety.barriers.stopping import Braking

_SPEED: Final = 3
"""Index of the speed in the state x, y, yaw, speed."""
_HALVINGS: Final = 12
"""Bisection steps: a resolution of 0.0005 of the throttle's range, finer than any motor's."""


def throttle_for(
    model: AbstractDynamics,
    state: FloatArray,
    steer: float,
    acceleration: float,
    bounds: tuple[float, float],
    latent: FloatArray | None = None,
) -> float:
    """Returns the throttle within ``bounds`` whose acceleration in the model is closest to ``acceleration`` [m/s2].

    Found by bisection, because the acceleration increases monotonically with the throttle, with a kink at a dead zone.
    Actuators are taken as settled; otherwise a lag would require too large a throttle. ``state`` (4,), ``latent``
    (latents,). Raises InputError when the model's speed is not finite.
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
    """The backup controller of a car with a throttle: brakes with the guaranteed deceleration, wheels straight.

    d|v|/dt = -min(gain |v|, deceleration), as the barriers assume; throttle 0 would let the car roll. When a state has
    no valid speed, the last speed minus the braking since then is used, so that a car whose sensor fails is stopped and
    not driven backwards.
    """

    def __init__(self, model: AbstractDynamics, braking: Braking, bounds: tuple[float, float]) -> None:
        self._model, self._braking, self._bounds = model, braking, bounds
        self._latent: FloatArray | None = None
        self._state: FloatArray | None = None
        """The newest valid state, with the currently assumed speed."""

    def learn(self, latent: FloatArray | None) -> None:
        """Sets the latent (latents,) to use; None for the value in the model file."""
        self._latent = latent

    def follow(self, values: Sequence[float], period: float) -> None:
        """Updates the state of a tick; if it is implausible, the assumed speed decreases as under braking."""
        reported = np.array(values, dtype=np.float64)
        if len(reported) == len(self._model.system.state) and self._model.system.is_plausible(reported):
            self._state = reported
        elif self._state is not None:
            speed = float(self._state[_SPEED])
            left = max(abs(speed) - self._deceleration(speed) * period, 0.0)
            self._state[_SPEED] = copysign(left, speed)

    def remember(self, former: BrakingByThrottle) -> None:
        """Takes over the assumed state from its predecessor."""
        self._state = former._state

    def __call__(self, state: FloatArray | None) -> FloatArray:
        """Returns the backup action (2,) at ``state`` (4,), or at the newest valid state."""
        at = self._state if state is None else state
        if at is None or at[_SPEED] == 0.0:
            return np.zeros(2)
        speed = float(at[_SPEED])
        wanted = copysign(self._deceleration(speed), -speed)
        return np.array([throttle_for(self._model, at, 0.0, wanted, self._bounds, self._latent), 0.0])

    def _deceleration(self, speed: float) -> float:
        return min(self._braking.gain * abs(speed), self._braking.deceleration)
