"""Integrators over named scalars: the classical Runge-Kutta method of order 4, and Euler's."""

from __future__ import annotations

from collections.abc import Callable

from safedpa.effects.effect import Named
from safedpa.operations import Scalar

__all__ = ["Derivative", "euler", "runge_kutta"]

Derivative = Callable[[Named, Scalar], Named]


def euler(derivative: Derivative, state: Named, time: Scalar, period: float) -> Named:
    """Returns state + period derivative(state, time)."""
    rates = derivative(state, time)
    return {name: value + period * rates[name] for name, value in state.items()}


def runge_kutta(derivative: Derivative, state: Named, time: Scalar, period: float) -> Named:
    """Returns the state after ``period`` [s] of d(state)/dt = derivative(state, time); local error O(period^5).

    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section II.1.
    """
    # computed once: period may be an array over many robots, or a number that is being recorded
    half, sixth = 0.5 * period, period / 6.0
    first = derivative(state, time)
    second = derivative({name: value + half * first[name] for name, value in state.items()}, time + half)
    third = derivative({name: value + half * second[name] for name, value in state.items()}, time + half)
    fourth = derivative({name: value + period * third[name] for name, value in state.items()}, time + period)
    # the order of these operations is fixed: generated, recorded and reference steps must agree to the last bit
    return {
        name: value + sixth * (first[name] + 2.0 * (second[name] + third[name]) + fourth[name])
        for name, value in state.items()
    }
