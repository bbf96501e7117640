"""Chooses the fastest barrier set: one compiled function if all barriers are equations, else one by one."""

from __future__ import annotations

from collections.abc import Sequence
from operator import is_
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrier, AbstractBarrierSet, Barriers
from safedpa.safety.barriers.equation import AbstractEquationBarrier, Pattern, pattern_of, rows_of
from safedpa.safety.checks.compatibility import check_reads

__all__ = ["BarrierSetCache", "CompiledBarrierSet", "make_barrier_set"]


def make_barrier_set(parts: Sequence[AbstractBarrier]) -> AbstractBarrierSet:
    """Returns the fastest set of these barriers, in this order.

    If all are equations, that is one recorded function; otherwise they are evaluated one by one.
    """
    if isinstance(parts, AbstractBarrierSet):
        return parts
    # Mixed lists are not split: one row order for all parts keeps names, margins and rows aligned.
    equations = [part for part in parts if isinstance(part, AbstractEquationBarrier)]
    return CompiledBarrierSet(equations) if equations and len(equations) == len(parts) else Barriers(parts)


@final
class BarrierSetCache:
    """``make_barrier_set`` for parts that are mostly those of the last tick: the last set is kept.

    ``states`` are the names of the state entries; empty: not known.
    """

    def __init__(self, states: Sequence[str] = ()) -> None:
        self._states = tuple(states)
        self._entries = -1
        self._last: AbstractBarrierSet = Barriers(())
        self._given: AbstractBarrierSet = self._last

    def get(self, parts: Sequence[AbstractBarrier], entries: int) -> AbstractBarrierSet:
        """Returns the set of exactly these objects, for a state with so many entries.

        Raises InputError for an object that is no list, for an entry that is no barrier, or one of other states.
        """
        if entries != self._entries:
            # The number of entries is part of what was checked, so a state of another size starts again.
            self._last, self._given, self._entries = Barriers(()), Barriers(()), entries
        # The usual case of a ready-made set: one comparison, no check.
        if parts is self._given:
            return parts
        if isinstance(parts, AbstractBarrierSet):
            check_reads(parts.parts, self._states, entries)
            self._given = parts
            return parts
        known = self._last.parts
        try:
            count = len(parts)
        except TypeError as error:
            raise InputError(f"barriers: got {type(parts).__name__}, wanted a list of them") from error
        # By identity, not equality: comparing obstacles by value would take as long as building the set.
        if count != len(known) or not all(map(is_, parts, known)):
            check_reads(parts, self._states, entries)
            self._last = make_barrier_set(parts)
        return self._last


@final
class CompiledBarrierSet(AbstractBarrierSet):
    """Barriers that are equations, compiled to one function, so that common subexpressions are computed once.

    ``like``: a set of the same equations with the same items; only the shared numbers differ.
    """

    def __init__(self, parts: Sequence[AbstractEquationBarrier], like: CompiledBarrierSet | None = None) -> None:
        super().__init__(parts, like)
        self.equations = tuple(parts)
        self._pattern: Pattern = pattern_of(parts) if like is None else like._pattern
        self._shared = [part.shared for part in parts]
        self._each = [part.each for part in parts]
        self._by_size: dict[int, Any] = {}

    def h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return np.array(self.scalar_rows(len(state)).h_floats(state.tolist()))

    def grad_h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        rows = self.scalar_rows(len(state)).grad_h_floats(state.tolist(), range(len(self.names)))
        return np.array(rows).reshape(len(self.names), len(state))

    def h_floats(self, state: Sequence[float]) -> list[float]:  # noqa: D102
        h: list[float] = self.scalar_rows(len(state)).h_floats(state)
        return h

    def grad_h_floats(self, state: Sequence[float], rows: Sequence[int]) -> Sequence[Sequence[float]]:  # noqa: D102
        found: Sequence[Sequence[float]] = self.scalar_rows(len(state)).grad_h_floats(state, rows)
        return found

    def grad_bound(self, state: Sequence[float]) -> Sequence[float] | None:  # noqa: D102
        bound: Sequence[float] | None = self.scalar_rows(len(state)).grad_bound(state)
        return bound

    def scalar_rows(self, states: int) -> Any:  # noqa: D102
        rows = self._by_size.get(states)
        if rows is None:
            # Compiled on first use: a set that is only inspected needs no evaluator.
            rows = self._by_size[states] = rows_of(self._pattern, states)(self._shared, self._each)
        return rows

    def prepare(self, states: int) -> None:
        """Waits for the compiler, rather than letting Python answer until it is done."""
        rows_of(self._pattern, states).wait()

    def __getstate__(self) -> dict[str, Any]:
        """Compiled functions cannot be pickled; the receiving process compiles them again."""
        return {**self.__dict__, "_by_size": {}}
