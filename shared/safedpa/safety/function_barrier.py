"""A barrier from a user's own function h."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.numbers_returned import numbers_returned, read_only

__all__ = ["FunctionBarrier"]

Values = NDArray[np.float64]

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
        h: Callable[[Values], ArrayLike],
        gradient: Callable[[Values], ArrayLike] | None = None,
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

    def values(self, state: Values) -> Values:  # noqa: D102
        return self._shaped("h", self._h(read_only(state)), (len(self.names),))

    def evaluate(self, state: Values) -> tuple[Values, Values]:  # noqa: D102
        h = self.values(state)
        if self._gradient is None:
            return h, self._differences(state)
        return h, self._shaped("gradient of h", self._gradient(read_only(state)), (len(self.names), len(state)))

    def along(self, state: Values, directions: Values) -> Values:
        """As in every barrier; without a gradient differences along the directions, which know the state's scale."""
        if self._gradient is not None:
            return super().along(state, directions)
        slopes = np.zeros((len(self.names), directions.shape[1]))
        for index, direction in enumerate(directions.T):
            if direction.any():
                ahead, behind = self.values(state + _SHARE * direction), self.values(state - _SHARE * direction)
                slopes[:, index] = (ahead - behind) / (2.0 * _SHARE)
        return slopes

    def _differences(self, state: Values) -> Values:
        gradient = np.empty((len(self.names), len(state)))
        for index, nudge in enumerate(_NUDGE * np.maximum(1.0, np.abs(state))):
            up, down = state.copy(), state.copy()
            up[index] += nudge
            down[index] -= nudge
            up.setflags(write=False)
            down.setflags(write=False)
            gradient[:, index] = (self.values(up) - self.values(down)) / (up[index] - down[index])
        return gradient

    def _shaped(self, what: str, value: Any, shape: tuple[int, ...]) -> Values:
        array = numbers_returned(what, value)
        if len(self.names) == 1 and array.shape == shape[1:]:
            array = array.reshape(shape)
        if array.shape != shape:
            raise InputError(f"{what} of barrier {', '.join(self.names)}: got shape {array.shape}, wanted {shape}")
        return array
