"""Dry friction near rest: rounded off, so that nothing chatters and slopes mean something there, or holding exactly."""

from __future__ import annotations

from typing import Final

from safedpa.effects.effect import Context
from safedpa.operations import Scalar

__all__ = ["REST_RATE", "REST_SPEED", "direction_of", "resistance"]

REST_SPEED: Final = 0.03
"""m/s; below it a car counts as nearly at rest in steps of 0.05 s: a hundredth of its usual speed, the noise of a good
speed sensor."""
REST_RATE: Final = 0.02
"""rad/s; the same for a pendulum: one degree per second."""
_STEP: Final = 0.05
"""s; shorter steps round off less, in proportion: what is at rest on a slope shall not creep more than it must."""


def direction_of(speed: Scalar, deceleration: Scalar, rest: float, context: Context) -> Scalar:
    """tanh(speed / width), width = period max(rest / 0.05 s, deceleration): sign(speed), rounded off near rest.

    A friction of constant size ``deceleration`` would reverse a slow motion within one period instead of stopping it.
    With this width its rate of decay at rest, deceleration / width, is at most 1 / period, for which Runge-Kutta's
    method neither overshoots nor oscillates (it would be unstable from 2.78 / period).
    """
    width = context.operations.maximum(deceleration, rest / _STEP) * context.period
    return context.operations.tanh(speed / width)


def resistance(
    rate: Scalar, speed: Scalar, deceleration: Scalar, rest: float, context: Context, inertia: Scalar = 1.0
) -> Scalar:
    """What a dry friction of size ``deceleration`` takes off ``rate``, d(speed)/dt without it.

    Rounded off near rest: deceleration direction_of(speed). Where ``context.holds``, what would bring the robot to rest
    within a period, at most its size d: clip(clip(rate, +-d) + inertia speed / period, +-d). So what is driven by less
    than its friction is stationary; rounded off it creeps, at up to half a metre a second per m/s2 of friction and s of
    period. ``inertia``: by what the rate is divided after the friction.

    Source: Karnopp, Journal of Dynamic Systems, Measurement, and Control 107, 1985 (stick and slip).
    """
    if context.holds:
        clip = context.operations.clip
        # what drives harder than the friction turns the motion back soon, but not yet: its sign is that of the speed
        pushed = clip(rate, -deceleration, deceleration)
        return clip(pushed + inertia * speed / context.period, -deceleration, deceleration)
    return deceleration * direction_of(speed, deceleration, rest, context)
