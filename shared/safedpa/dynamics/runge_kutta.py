"""Integration over named scalars: the classical Runge-Kutta method, and the step of Euler."""

from __future__ import annotations

from collections.abc import Callable

from safedpa.effects.effect import Named
from safedpa.operations import Scalar

__all__ = ["Derivative", "euler", "runge_kutta"]

Derivative = Callable[[Named, Scalar], Named]


def euler(derivative: Derivative, state: Named, time: Scalar, period: float) -> Named:
    """state + period derivative(state, time)."""
    rates = derivative(state, time)
    return {name: value + period * rates[name] for name, value in state.items()}


def runge_kutta(derivative: Derivative, state: Named, time: Scalar, period: float) -> Named:
    """The state after ``period`` [s] from d(state)/dt = derivative(state, time); local error of order period^5.

    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section II.1.
    """
    half, sixth = 0.5 * period, period / 6.0
    first = derivative(state, time)
    second = derivative({name: value + half * first[name] for name, value in state.items()}, time + half)
    third = derivative({name: value + half * second[name] for name, value in state.items()}, time + half)
    fourth = derivative({name: value + period * third[name] for name, value in state.items()}, time + period)
    return {
        name: value + sixth * (first[name] + 2.0 * (second[name] + third[name]) + fourth[name])
        for name, value in state.items()
    }
