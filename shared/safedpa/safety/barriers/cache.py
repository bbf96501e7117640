"""A cache of h at the last few states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, final

__all__ = ["BarrierValueCache"]

_STATES: Final = 8
"""The measured state, the predicted ones of a decision's iterations, and the one expected from the last tick."""


@final
class BarrierValueCache:
    """A scalar evaluator (``scalar_rows`` of a barrier set) with a cache of h.

    The returned lists are shared and must not be changed.
    """

    def __init__(self, barriers: Any) -> None:
        self.barriers = barriers
        self._known: list[tuple[float, tuple[float, ...], list[float]]] = []
        """First entry, state and h in one tuple: threads that share barriers see a whole entry or none of it."""
        self._oldest = 0

    def h_floats(self, state: Sequence[float]) -> list[float]:
        """h (m,) at ``state`` (states,)."""
        first: float = state[0]
        known = self._known
        # Most states differ in their first entry: one comparison of floats, without hashing a tuple.
        for index in range(len(known)):
            entry = known[index]
            if entry[0] == first and entry[1] == tuple(state):
                return entry[2]
        key = tuple(state)
        h: list[float] = self.barriers.h_floats(key)
        if len(known) < _STATES:
            known.append((first, key, h))
            return h
        # Round robin instead of least recently used: no bookkeeping on a hit, and a tick needs fewer states than there
        # are places.
        place = self._oldest
        known[place] = first, key, h
        self._oldest = place + 1 if place + 1 < _STATES else 0
        return h

    def grad_h_floats(self, state: Sequence[float], rows: Sequence[int]) -> Any:
        """d(h_i)/d(x_j) of ``rows``; not cached, since a decision needs it once."""
        return self.barriers.grad_h_floats(state, rows)

    def lie_derivative_floats(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> Any:
        """d(h_i)/d(a_j) of ``rows``, if the state changes by g a."""
        return self.barriers.lie_derivative_floats(state, g, widths, rows)

    def grad_bound(self, state: Sequence[float]) -> Any:
        """An upper bound (states,) of |d(h_i)/d(x_j)|; None if not known."""
        return self.barriers.grad_bound(state)
