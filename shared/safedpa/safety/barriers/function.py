"""A barrier from a user's own function h.

Slopes of a function of the state by central differences, with steps that have no unit.

The step of an entry x_j follows what that entry itself moves, and, where it does not move, what the function answers
to. So the slopes of a function are the same whether x_j is told in metres, in micrometres, or as a place on the earth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.validation import checked_output, read_only

__all__ = [
    "FunctionBarrier",
    "central_slopes",
]


_NUDGE = 6e-6
"""Relative step of the central difference: the cube root of the rounding error balances both of its errors."""
_SHARE = 1e-3
"""Of what the actions' whole range moves, over which h is differenced: rounding errors of h are as often smaller."""


@final
class FunctionBarrier(AbstractBarrier):
    """h(x) >= 0 from ``h(state (states,)) -> float or (m,)``.

    ``gradient(state)`` is (states,) or (m, states).

    Without a gradient central differences are taken, step 6e-6 max(1, |x_j|): error about 1e-10 for smooth h of size 1.
    ``names`` says how many values h has (default: one), ``reads`` the states that it is written for. h and its gradient
    see arrays that they cannot write into. Raises InputError for what is no function, and at evaluation when a shape is
    wrong, or what came back are no real numbers.
    """

    def __init__(
        self,
        h: Callable[[FloatArray], ArrayLike],
        gradient: Callable[[FloatArray], ArrayLike] | None = None,
        names: Sequence[str] = ("h",),
        kind: str = "function",
        reads: Sequence[str] = (),
    ) -> None:
        for what, function in (("h", h), ("gradient", gradient)):
            if not callable(function) and (what == "h" or function is not None):
                raise InputError(f"{what}: got {type(function).__name__}, wanted a function of the state")
        if isinstance(names, str) or not names or not all(isinstance(name, str) for name in names):
            raise InputError(f"names: got {names!r}, wanted a sequence with one name for each value of h")
        if not isinstance(kind, str):
            raise InputError(f"kind: got {kind!r}, wanted the name by which epsilon has a margin for it")
        if isinstance(reads, str):
            raise InputError(f"reads: got {reads!r}, wanted a sequence with the names of the states")
        self.names, self.kind, self.reads = tuple(names), kind, tuple(reads)
        self._h, self._gradient = h, gradient

    def values(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return self._shaped("h", self._h(read_only(state)), (len(self.names),))

    def evaluate(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: D102
        h = self.values(state)
        if self._gradient is None:
            return h, self._differences(state)
        return h, self._shaped("gradient of h", self._gradient(read_only(state)), (len(self.names), len(state)))

    def along(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """As in every barrier; without a gradient differences along the directions, which know the state's scale."""
        if self._gradient is not None:
            return super().along(state, directions)
        slopes = np.zeros((len(self.names), directions.shape[1]))
        for index, direction in enumerate(directions.T):
            if direction.any():
                ahead, behind = self.values(state + _SHARE * direction), self.values(state - _SHARE * direction)
                slopes[:, index] = (ahead - behind) / (2.0 * _SHARE)
        return slopes

    def _differences(self, state: FloatArray) -> FloatArray:
        gradient = np.empty((len(self.names), len(state)))
        for index, nudge in enumerate(_NUDGE * np.maximum(1.0, np.abs(state))):
            up, down = state.copy(), state.copy()
            up[index] += nudge
            down[index] -= nudge
            up.setflags(write=False)
            down.setflags(write=False)
            gradient[:, index] = (self.values(up) - self.values(down)) / (up[index] - down[index])
        return gradient

    def _shaped(self, what: str, value: Any, shape: tuple[int, ...]) -> FloatArray:
        array = checked_output(what, value)
        if len(self.names) == 1 and array.shape == shape[1:]:
            array = array.reshape(shape)
        if array.shape != shape:
            raise InputError(f"{what} of barrier {', '.join(self.names)}: got shape {array.shape}, wanted {shape}")
        return array


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


def central_slopes(
    function: Callable[[FloatArray], FloatArray], state: FloatArray, moved: FloatArray, size: FloatArray
) -> FloatArray:
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
    function: Callable[[FloatArray], FloatArray], state: FloatArray, index: int, step: float, size: FloatArray
) -> tuple[FloatArray, float, FloatArray] | None:
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
