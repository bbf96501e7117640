"""A barrier from a user's own function h."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractBarrier

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
    ``names`` says how many values h has (default: one). Raises InputError at evaluation when a shape is wrong.
    """

    def __init__(
        self,
        h: Callable[[Values], ArrayLike],
        gradient: Callable[[Values], ArrayLike] | None = None,
        names: Sequence[str] = ("h",),
        kind: str = "function",
    ) -> None:
        if isinstance(names, str) or not names:
            raise InputError(f"names: got {names!r}, wanted a sequence with one name for each value of h")
        self.names, self.kind = tuple(names), kind
        self._h, self._gradient = h, gradient

    def values(self, state: Values) -> Values:  # noqa: D102
        return self._shaped("h", self._h(state), (len(self.names),))

    def evaluate(self, state: Values) -> tuple[Values, Values]:  # noqa: D102
        h = self.values(state)
        if self._gradient is None:
            return h, self._differences(state)
        return h, self._shaped("gradient of h", self._gradient(state), (len(self.names), len(state)))

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
            gradient[:, index] = (self.values(up) - self.values(down)) / (up[index] - down[index])
        return gradient

    def _shaped(self, what: str, value: Any, shape: tuple[int, ...]) -> Values:
        array = np.asarray(value, dtype=np.float64)
        if len(self.names) == 1 and array.shape == shape[1:]:
            array = array.reshape(shape)
        if array.shape != shape:
            raise InputError(f"{what} of barrier {', '.join(self.names)}: got shape {array.shape}, wanted {shape}")
        return array
