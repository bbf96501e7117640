"""The quickest stack for barriers: those that are equations in one go, any others one by one."""

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
    """The quickest stack of these barriers, in this order: one recorded function where all are equations.

    Any others are asked one by one, which is the reference.
    """
    if isinstance(parts, AbstractBarrierSet):
        return parts
    equations = [part for part in parts if isinstance(part, AbstractEquationBarrier)]
    return CompiledBarrierSet(equations) if equations and len(equations) == len(parts) else Barriers(parts)


@final
class BarrierSetCache:
    """``make_barrier_set`` for parts that are mostly those of the last tick: their stack is kept.

    ``states`` are the names of the state's entries; empty: not known.
    """

    def __init__(self, states: Sequence[str] = ()) -> None:
        self._states = tuple(states)
        self._entries = -1
        self._last: AbstractBarrierSet = Barriers(())
        self._given: AbstractBarrierSet = self._last

    def of(self, parts: Sequence[AbstractBarrier], entries: int) -> AbstractBarrierSet:
        """The stack of just these objects, for a state with so many entries.

        Raises InputError for what is no list, for one that is no barrier, or reads other states.
        """
        if entries != self._entries:
            self._last, self._given, self._entries = Barriers(()), Barriers(()), entries
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
        if count != len(known) or not all(map(is_, parts, known)):
            check_reads(parts, self._states, entries)
            self._last = make_barrier_set(parts)
        return self._last


@final
class CompiledBarrierSet(AbstractBarrierSet):
    """Barriers that are equations, in one function: what they compute alike is computed once.

    ``like``: a stack of the same equations with the same items, whose shared numbers alone are others.
    """

    def __init__(self, parts: Sequence[AbstractEquationBarrier], like: CompiledBarrierSet | None = None) -> None:
        super().__init__(parts, like)
        self.equations = tuple(parts)
        self._pattern: Pattern = pattern_of(parts) if like is None else like._pattern
        self._shared = [part.shared for part in parts]
        self._each = [part.each for part in parts]
        self._plain: dict[int, Any] = {}

    def values(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return np.array(self.plain(len(state)).heights(state.tolist()))

    def gradient(self, state: FloatArray) -> FloatArray:  # noqa: D102
        rows = self.plain(len(state)).slopes(state.tolist(), range(len(self.names)))
        return np.array(rows).reshape(len(self.names), len(state))

    def heights(self, state: Sequence[float]) -> list[float]:  # noqa: D102
        h: list[float] = self.plain(len(state)).heights(state)
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> Sequence[Sequence[float]]:  # noqa: D102
        found: Sequence[Sequence[float]] = self.plain(len(state)).slopes(state, rows)
        return found

    def steepest(self, state: Sequence[float]) -> Sequence[float] | None:  # noqa: D102
        bound: Sequence[float] | None = self.plain(len(state)).steepest(state)
        return bound

    def plain(self, states: int) -> Any:  # noqa: D102
        rows = self._plain.get(states)
        if rows is None:
            rows = self._plain[states] = rows_of(self._pattern, states)(self._shared, self._each)
        return rows

    def __getstate__(self) -> dict[str, Any]:
        """Functions made here do not travel to another process; they are made there again."""
        return {**self.__dict__, "_plain": {}}
