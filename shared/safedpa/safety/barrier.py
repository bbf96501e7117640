"""A barrier: h(x) >= 0 describes the safe set; one object may hold many of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import chain
from typing import final

import numpy as np
from numpy.typing import NDArray

__all__ = ["AbstractBarrier", "Barriers", "RememberingBarrier"]

Values = NDArray[np.float64]

_REMEMBERED_STATES = 8
"""The measured one, the predicted ones of a decision's rounds, and the one expected from the last tick."""


class AbstractBarrier(ABC):
    """m functions h_i(x) >= 0 of the state x (states,), in a unit of the barrier's own choice."""

    kind: str
    """Which margin applies: ``obstacle``, ``field``, ``speed`` or a name of the user's own."""
    names: tuple[str, ...]
    """(m,) what each of them is called in verdicts."""

    @abstractmethod
    def values(self, state: Values) -> Values:
        """h (m,) at ``state`` (states,)."""

    @abstractmethod
    def evaluate(self, state: Values) -> tuple[Values, Values]:
        """h (m,) and its gradient d(h_i)/d(x_j) (m, states) at ``state`` (states,)."""


@final
class RememberingBarrier(AbstractBarrier):
    """Another barrier, with h at the last few states remembered: within one tick the same states come up again.

    A prediction is judged when the action is decided, and again beside the measured state when the margin is watched.
    The arrays that it hands out are shared, and so cannot be written to.
    """

    def __init__(self, part: AbstractBarrier) -> None:
        self._part, self.kind, self.names = part, part.kind, part.names
        self._known: dict[bytes, Values] = {}

    def values(self, state: Values) -> Values:  # noqa: D102
        key = state.tobytes()
        h = self._known.get(key)
        if h is None:
            if len(self._known) >= _REMEMBERED_STATES:
                del self._known[next(iter(self._known))]
            h = self._known[key] = self._part.values(state)
            h.flags.writeable = False
        return h

    def evaluate(self, state: Values) -> tuple[Values, Values]:  # noqa: D102
        return self._part.evaluate(state)


@final
class Barriers:
    """Several barriers, side by side: h stacked in the order given."""

    def __init__(self, parts: Sequence[AbstractBarrier]) -> None:
        self.parts = tuple(parts)
        self.names = tuple(chain.from_iterable(part.names for part in self.parts))

    def __len__(self) -> int:
        return len(self.names)

    def values(self, state: Values) -> Values:
        """h (m,) of all parts at ``state`` (states,)."""
        return np.concatenate([part.values(state) for part in self.parts])

    def evaluate(self, state: Values) -> tuple[Values, Values]:
        """h (m,) and gradient (m, states) of all parts at ``state`` (states,)."""
        pairs = [part.evaluate(state) for part in self.parts]
        return np.concatenate([h for h, _ in pairs]), np.concatenate([gradient for _, gradient in pairs])

    def of_each(self, by_kind: dict[str, float], otherwise: float) -> Values:
        """(m,) the number that belongs to each barrier's kind."""
        numbers: list[float] = []
        for part in self.parts:
            numbers += [by_kind.get(part.kind, otherwise)] * len(part.names)
        return np.array(numbers, dtype=np.float64)
