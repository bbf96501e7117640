"""Dry friction near rest: smoothed, so that nothing chatters and slopes exist, or holding exactly."""

from __future__ import annotations

from typing import Final

from safedpa.effects.effect import Context
from safedpa.operations import Scalar

REST_SPEED: Final = 0.03
"""m/s; width of the smoothing for a car in steps of 0.05 s: a hundredth of its usual speed, about the noise of a good
speed sensor."""
REST_RATE: Final = 0.02
"""rad/s; the same for a pendulum: one degree per second."""
_STEP: Final = 0.05
"""s; shorter steps are smoothed less, in proportion, so that a robot at rest on a slope creeps less."""


def direction_of(speed: Scalar, deceleration: Scalar, rest: float, context: Context) -> Scalar:
    """Returns tanh(speed / width), width = period max(rest / 0.05 s, deceleration): sign(speed), smoothed near rest.

    A friction of constant size ``deceleration`` would reverse a slow motion within one period instead of stopping it.
    With this width its rate of decay at rest, deceleration / width, is at most 1 / period, for which Runge-Kutta's
    method neither overshoots nor oscillates (it would be unstable from 2.78 / period).
    """
    width = context.operations.maximum(deceleration, rest / _STEP) * context.period
    return context.operations.tanh(speed / width)


def resistance(
    rate: Scalar, speed: Scalar, deceleration: Scalar, rest: float, context: Context, inertia: Scalar = 1.0
) -> Scalar:
    """Returns what dry friction of size ``deceleration`` subtracts from ``rate``, d(speed)/dt without it.

    Smoothed near rest: deceleration direction_of(speed). If ``context.holds``, what would bring the robot to rest
    within a period, at most its size d: clip(clip(rate, +-d) + inertia speed / period, +-d). So a robot that is driven
    by less than its friction stays at rest; smoothed, it creeps at up to 0.5 m/s per m/s2 of friction and s of period.
    ``inertia``: what the rate is divided by after the friction.

    Source: Karnopp, Journal of Dynamic Systems, Measurement, and Control 107, 1985 (stick and slip).
    """
    if context.holds:
        clip = context.operations.clip
        # a stronger drive will reverse the motion, but not yet: friction has the sign of the present speed
        pushed = clip(rate, -deceleration, deceleration)
        return clip(pushed + inertia * speed / context.period, -deceleration, deceleration)
    return deceleration * direction_of(speed, deceleration, rest, context)
