"""Pruning of irrelevant discs: those whose h is so large that no action can violate their constraint.

An action begins to act ``late`` seconds after the state and acts for one period p. The speed is then at most u = |v| +
A (late + p). In s seconds the car moves at most R u s, turns by at most K u s, and changes its speed by at most A s.
With the bounds of the barrier's derivatives at that speed, h decreases in s seconds by at most

    F(s) = sqrt(2) place R u s + arm K u s + change A s,

and every action satisfies the constraint h(x+) >= (1 - eta) h(x) + epsilon if

    h >= F(late) + (F(p) + epsilon) / eta,     or F(late) + F(p) + epsilon for a barrier that may use up h at once.

This needs an h with these derivative bounds everywhere, so for hidden positions the h with the speed behind the car is
used. epsilon is doubled, because an online margin may increase before the decision.

No part of the body is farther from the car's position p than the longest arm L, and a mover at up to speed w can move
w T(v) until the car stops, so a disc at c has

    h >= |c - p| - L - reach - w T(v),

by which ``disc_selection`` drops most discs before their h is computed. The module is compiled by mypyc.
"""

from __future__ import annotations

from math import isfinite, sqrt
from typing import Final

from safedpa.bus import StateMessage
from safedpa.robots.car.dynamics.limits import PerformanceLimits
from safedpa.safety.barriers.equation import AbstractEquationBarrier

_WIDENED: Final = 2.0


def irrelevance_distance(
    barrier: AbstractEquationBarrier,
    state: StateMessage,
    eta: float,
    epsilon: float,
    late: float,
    car: PerformanceLimits,
) -> float:
    """Returns the value of h [m] from which on no action of one period can violate the constraint of a disc.

    ``barrier`` is any one with the same shared parameters, for the state x, y, yaw, speed, with bounded derivatives.
    ``car`` holds A, K and R of the model.
    """
    if not isfinite(car.acceleration + car.curvature + car.reach):
        return float("inf")
    speed = abs(state.values[3]) + car.acceleration * (late + state.period)
    place, arm, change = 0.0, 0.0, 0.0
    rows = barrier.scalar_rows(len(state.values))
    for signed in (speed, -speed):
        bounds = rows.grad_bound((*state.values[:3], signed))
        if bounds is None:
            return float("inf")
        x, y, turned, faster = bounds
        place, arm, change = max(place, x, y), max(arm, turned), max(change, faster)
    each_second = sqrt(2.0) * place * car.reach * speed + arm * car.curvature * speed + change * car.acceleration
    spent = each_second * state.period + _WIDENED * epsilon
    return each_second * late + (spent if barrier.at_once else spent / eta)
