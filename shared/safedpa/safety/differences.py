"""Slopes of a function of the state by central differences, with steps that have no unit.

The step of an entry x_j follows what that entry itself moves, and, where it does not move, what the function answers
to. So the slopes of a function are the same whether x_j is told in metres, in micrometres, or as a place on the earth.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["central_slopes"]

Values = NDArray[np.float64]

_EPSILON: Final = float(np.finfo(np.float64).eps)
_ROUNDING: Final = 16.0 * _EPSILON
_SEEN: Final = 1e-10
"""Share of the function's size by which it must answer: a millionth of that is rounding."""
_SMALLEST: Final = 1e-18
"""First step of an entry that neither moves nor is there; it grows from here, so it is no unit."""
_GROWTH: Final = 1e3
_STILL: Final = 1e-13
"""Share of the largest number there is by which an entry moves at least: less may be rounding of something else, or an
entry in a far larger unit, and only steps beyond it tell which."""
_FURTHEST: Final = 1e9
"""Steps grow to so many times the largest number of the state."""


def central_slopes(function: Callable[[Values], Values], state: Values, moved: Values, size: Values) -> Values:
    """d(function_i)/d(x_j) (m, states) at ``state`` (states,).

    ``moved`` (states,) >= 0 is how far each entry moves by itself; ``size`` (m,) > 0 how large each value is. The step
    is moved (eps max(1, |x| / moved))^(1/3), where the errors of curvature and of rounding balance. An entry to whose
    step no value answers gets a larger one, a thousand times each, until it is as far as the entry moves; one that does
    not move, until it is 1e9 times the largest number there is. What a larger step says is believed where it is no
    further from the last one than that one's rounding: there it is the finer of the two, else it is curvature.
    """
    slopes = np.zeros((len(size), len(state)))
    largest = max(float(np.max(np.abs(state))), float(np.max(moved)))
    furthest = _FURTHEST * largest if largest > 0.0 else 1.0 / _SMALLEST
    for index in range(len(state)):
        far = float(moved[index])
        step, doubt = _first_step(abs(float(state[index])), far), np.full(len(size), np.inf)
        while step <= (far if far > _STILL * largest else furthest):
            found = _difference(function, state, index, step, size)
            if found is None:
                break
            slope, answer, rounding = found
            better = np.abs(slope - slopes[:, index]) <= doubt + rounding
            slopes[better, index], doubt[better] = slope[better], rounding[better]
            if answer >= _SEEN:
                break
            step *= _GROWTH
    return slopes


def _first_step(value: float, moved: float) -> float:
    if moved > 0.0:
        return moved * float(np.cbrt(_EPSILON * max(1.0, value / moved)))
    return max(_SMALLEST, _EPSILON * value)


def _difference(
    function: Callable[[Values], Values], state: Values, index: int, step: float, size: Values
) -> tuple[Values, float, Values] | None:
    """Slopes (m,), the largest share of its size by which a value answers, and the slopes' rounding (m,).

    None where the function has no finite answer.
    """
    up, down = state.copy(), state.copy()
    up[index] += step
    down[index] -= step
    width = float(up[index] - down[index]) or step
    try:
        with np.errstate(all="ignore"):
            change = function(up) - function(down)
    except (ArithmeticError, ValueError):
        return None
    if not np.isfinite(change).all():
        return None
    return change / width, float(np.max(np.abs(change) / size)), _ROUNDING * size / width
