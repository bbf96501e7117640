"""How large h of a disc has to be for no action to break its condition, so that it need not be looked at.

From where an action begins to act, ``late`` seconds after the state, it is in force for one period p. By then the speed
is u = |v| + A (late + p) at most, in s seconds the car goes no farther than R u s, turns by no more than K u s, and its
speed changes by no more than A s. With the bounds of the barrier's slopes at that speed, h falls in s seconds by

    F(s) = sqrt(2) place R u s + arm K u s + change A s                                  at the most,

and the condition h(x+) >= (1 - eta) h(x) + epsilon is kept by every action where

    h >= F(late) + (F(p) + epsilon) / eta,     or F(late) + F(p) + epsilon where all of h may be used up at once.

That holds for an h with such slopes all over: of a place that nobody sees the h that counts who hides behind as well.
Twice the margin is taken for epsilon: it is watched, and may widen before the decision is made.
"""

from __future__ import annotations

from math import isfinite, sqrt
from typing import Final

from safedpa.bus import StateMessage
from safedpa.robots.car.quickness import Quickness
from safedpa.safety.equation_barrier import AbstractEquationBarrier

__all__ = ["far_of"]

_WIDENED: Final = 2.0


def far_of(
    barrier: AbstractEquationBarrier, state: StateMessage, eta: float, epsilon: float, late: float, car: Quickness
) -> float:
    """h [m] of an item of ``barrier`` from which on no action of one period breaks its condition.

    ``barrier``: any with the same shared numbers; of the state x, y, yaw, speed, whose slopes are bounded. ``car``: A,
    K and R of its model.
    """
    if not isfinite(car.acceleration + car.curvature + car.reach):
        return float("inf")
    speed = abs(state.values[3]) + car.acceleration * (late + state.period)
    place, arm, change = 0.0, 0.0, 0.0
    rows = barrier.alone(len(state.values))
    for signed in (speed, -speed):
        bounds = rows.steepest((*state.values[:3], signed))
        if bounds is None:
            return float("inf")
        x, y, turned, faster = bounds
        place, arm, change = max(place, x, y), max(arm, turned), max(change, faster)
    each_second = sqrt(2.0) * place * car.reach * speed + arm * car.curvature * speed + change * car.acceleration
    spent = each_second * state.period + _WIDENED * epsilon
    return each_second * late + (spent if barrier.at_once else spent / eta)
