"""h at the last few states, kept: within one tick the same states come up again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, final

__all__ = ["BarrierValueCache"]

_STATES: Final = 8
"""The measured one, the predicted ones of a decision's rounds, and the one expected from the last tick."""


@final
class BarrierValueCache:
    """Barriers over plain numbers (``heights``, ``slopes``, ``along``, ``steepest`` of ``AbstractStack``), remembered.

    The lists that it hands out are shared: no one may write into them.
    """

    def __init__(self, barriers: Any) -> None:
        self._barriers = barriers
        self._known: list[tuple[float, tuple[float, ...], list[float]]] = []
        """First entry, state and h in one: threads that share barriers see all of a place changed, or nothing."""
        self._oldest = 0

    def heights(self, state: Sequence[float]) -> list[float]:
        """h (m,) at ``state`` (states,)."""
        first: float = state[0]
        known = self._known
        for index in range(len(known)):  # mostly the first entry tells states apart, and nothing has to be hashed
            entry = known[index]
            if entry[0] == first and entry[1] == tuple(state):
                return entry[2]
        key = tuple(state)
        h: list[float] = self._barriers.heights(key)
        if len(known) < _STATES:
            known.append((first, key, h))
            return h
        place = self._oldest
        known[place] = first, key, h
        self._oldest = place + 1 if place + 1 < _STATES else 0
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> Any:
        """d(h_i)/d(x_j) of the rows asked for."""
        return self._barriers.slopes(state, rows)

    def along(self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]) -> Any:
        """d(h_i)/d(a_j) of the rows asked for, where the state moves by g a."""
        return self._barriers.along(state, g, widths, rows)

    def steepest(self, state: Sequence[float]) -> Any:
        """(states,) what no slope exceeds; None where that is not known."""
        return self._barriers.steepest(state)
