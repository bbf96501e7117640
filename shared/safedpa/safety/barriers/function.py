"""Barriers from a user's function h, and unit-free central differences of a function of the state.

The step of an entry x_j follows from how far that entry moves by itself, and, if it does not move, from the response of
the function. So the derivatives are the same whether x_j is given in metres, micrometres or as a geographic coordinate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.native.tracing import with_numpy
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.validation import checked_output, read_only

__all__ = [
    "FunctionBarrier",
    "central_differences",
]


_RELATIVE_STEP = 6e-6
"""Relative step of a central difference: the cube root of the rounding error balances truncation and rounding."""
_STEP_SHARE = 1e-3
"""Share of the motion by the actions' whole range over which h is differenced; rounding errors are as much smaller."""


@final
class FunctionBarrier(AbstractBarrier):
    """h(x) >= 0 from ``h(state (states,)) -> float or (m,)``.

    ``gradient(state)`` is (states,) or (m, states).

    Without a gradient central differences are used, with step 6e-6 max(1, |x_j|): the error is about 1e-10 for smooth h
    of size 1. ``names`` has one name for each value of h (default: one); ``reads`` are the states that h is written
    for. An h with a parameter ``operations`` gets the elementwise functions to compute with, and ``RolloutBarrier``
    compiles it. The functions get arrays that they cannot write into. Raises InputError for an object that is no
    function, and at evaluation for a wrong shape or a result that is not real.

    Example: the distance from a disc of 0.5 m at the origin.

        >>> disc = safedpa.FunctionBarrier(lambda x: np.hypot(x[0], x[1]) - 0.5, names=["disc"], kind="obstacle")
        >>> disc, disc.h(np.array([3.0, 4.0]))
        (FunctionBarrier(kind=obstacle, names=disc), array([4.5]))
    """

    def __init__(
        self,
        h: Callable[..., ArrayLike],
        gradient: Callable[..., ArrayLike] | None = None,
        names: Sequence[str] = ("h",),
        kind: str = "function",
        reads: Sequence[str] = (),
    ) -> None:
        for what, function in (("h", h), ("gradient", gradient)):
            if not callable(function) and (what == "h" or function is not None):
                raise InputError(f"{what}: got {type(function).__name__}, wanted a function of the state")
        # A string is a sequence of letters, and would give each value of h a one-letter name.
        if isinstance(names, str) or not names or not all(isinstance(name, str) for name in names):
            raise InputError(f"names: got {names!r}, wanted a sequence with one name for each value of h")
        if not isinstance(kind, str):
            raise InputError(f"kind: got {kind!r}, wanted the name by which epsilon has a margin for it")
        if isinstance(reads, str):
            raise InputError(f"reads: got {reads!r}, wanted a sequence with the names of the states")
        self.names, self.kind, self.reads = tuple(names), kind, tuple(reads)
        self.function = h
        """The function as given."""
        self._h, self._gradient = with_numpy(h), gradient

    def h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return self._with_shape("h", self._h(read_only(state)), (len(self.names),))

    def h_and_grad(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: D102
        h = self.h(state)
        if self._gradient is None:
            return h, self._differences(state)
        return h, self._with_shape("gradient of h", self._gradient(read_only(state)), (len(self.names), len(state)))

    def lie_derivative(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """As in every barrier; without a gradient, differences along the directions, which have the motion's scale."""
        if self._gradient is not None:
            return super().lie_derivative(state, directions)
        derivatives = np.zeros((len(self.names), directions.shape[1]))
        for index, direction in enumerate(directions.T):
            # A direction of zeros has derivative 0; evaluating h twice at the same state would only add rounding.
            if direction.any():
                ahead, behind = self.h(state + _STEP_SHARE * direction), self.h(state - _STEP_SHARE * direction)
                derivatives[:, index] = (ahead - behind) / (2.0 * _STEP_SHARE)
        return derivatives

    def _differences(self, state: FloatArray) -> FloatArray:
        gradient = np.empty((len(self.names), len(state)))
        for index, nudge in enumerate(_RELATIVE_STEP * np.maximum(1.0, np.abs(state))):
            up, down = state.copy(), state.copy()
            up[index] += nudge
            down[index] -= nudge
            # Read-only: a user's function that wrote into its argument would change the next difference.
            up.setflags(write=False)
            down.setflags(write=False)
            # Divided by the step that was actually taken: x + step is rounded.
            gradient[:, index] = (self.h(up) - self.h(down)) / (up[index] - down[index])
        return gradient

    def _with_shape(self, what: str, value: Any, shape: tuple[int, ...]) -> FloatArray:
        array = checked_output(what, value)
        # A single h may be returned as a number, and its gradient as one vector.
        if len(self.names) == 1 and array.shape == shape[1:]:
            array = array.reshape(shape)
        if array.shape != shape:
            raise InputError(f"{what} of barrier {', '.join(self.names)}: got shape {array.shape}, wanted {shape}")
        return array


_EPSILON: Final = float(np.finfo(np.float64).eps)
_ROUNDING: Final = 16.0 * _EPSILON
"""Rounding error of one evaluation, in units of the function's size."""
_MIN_RESPONSE: Final = 1e-10
"""Share of the function's size that a step must change: a millionth of that is rounding."""
_MIN_STEP: Final = 1e-18
"""First step of an entry that is 0 and does not move; it grows from here, so it implies no unit."""
_GROWTH: Final = 1e3
_MIN_MOTION: Final = 1e-13
"""Share of the largest entry by which an entry must move: less may be rounding of something else, or an entry in a far
larger unit, and only larger steps tell which."""
_MAX_STEP: Final = 1e9
"""Steps grow up to this multiple of the largest entry of the state."""


def central_differences(
    function: Callable[[FloatArray], FloatArray], state: FloatArray, moved: FloatArray, size: FloatArray
) -> FloatArray:
    """Returns d(function_i)/d(x_j) (m, states) at ``state`` (states,) by central differences.

    ``moved`` (states,) >= 0 is how far each entry moves by itself; ``size`` (m,) > 0 the size of each value. The step
    is moved (eps max(1, |x| / moved))^(1/3), which balances truncation and rounding errors. If no value responds, the
    step is multiplied by a thousand, up to the motion of the entry, or up to 1e9 times the largest entry if it does not
    move. The result of a larger step is used only if it differs from the last one by no more than its rounding error:
    it is then the more accurate one, otherwise the difference is curvature.
    """
    derivatives = np.zeros((len(size), len(state)))
    largest = max(float(np.max(np.abs(state))), float(np.max(moved)))
    max_step = _MAX_STEP * largest if largest > 0.0 else 1.0 / _MIN_STEP
    for index in range(len(state)):
        own_motion = float(moved[index])
        step, uncertainty = _first_step(abs(float(state[index])), own_motion), np.full(len(size), np.inf)
        while step <= (own_motion if own_motion > _MIN_MOTION * largest else max_step):
            found = _difference(function, state, index, step, size)
            if found is None:
                break
            derivative, response, rounding = found
            # Larger steps have less rounding but more curvature: they may refine a derivative within its uncertainty,
            # not replace it.
            better = np.abs(derivative - derivatives[:, index]) <= uncertainty + rounding
            derivatives[better, index], uncertainty[better] = derivative[better], rounding[better]
            if response >= _MIN_RESPONSE:
                break
            step *= _GROWTH
    return derivatives


def _first_step(value: float, moved: float) -> float:
    if moved > 0.0:
        return moved * float(np.cbrt(_EPSILON * max(1.0, value / moved)))
    return max(_MIN_STEP, _EPSILON * value)


def _difference(
    function: Callable[[FloatArray], FloatArray], state: FloatArray, index: int, step: float, size: FloatArray
) -> tuple[FloatArray, float, FloatArray] | None:
    """Derivatives (m,), the largest response of a value as a share of its size, and the rounding errors (m,).

    None if the function has no finite result.
    """
    up, down = state.copy(), state.copy()
    up[index] += step
    down[index] -= step
    # A step below the rounding of x leaves x unchanged; the nominal step then avoids a division by zero.
    width = float(up[index] - down[index]) or step
    try:
        with np.errstate(all="ignore"):
            change = function(up) - function(down)
    except (ArithmeticError, ValueError):
        return None
    if not np.isfinite(change).all():
        return None
    return change / width, float(np.max(np.abs(change) / size)), _ROUNDING * size / width
