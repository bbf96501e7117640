"""Barriers whose h is one equation over ``Operations``: values, gradients and batches are derived by recording it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from functools import cache
from typing import Any, Self

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.equations.batch_rows import BatchRows
from safedpa.equations.rows import Equation, Given, RowGroup, RowTape
from safedpa.native.steps import CompiledRows
from safedpa.operations import Operations, Scalar
from safedpa.safety.barriers.base import AbstractBarrier

__all__ = ["AbstractEquationBarrier", "Pattern", "batch_rows_of", "pattern_of", "rows_of", "tape_of"]


Pattern = tuple[tuple[type["AbstractEquationBarrier"], int, int, tuple[int, ...], int], ...]
"""For each part: its class, the number of shared numbers and of numbers per item, its form, and the index of the first
part with the same shared numbers, or -1."""


class AbstractEquationBarrier(AbstractBarrier):
    """h_i(x) >= 0 for i = 1..m items with one or more rows each: a subclass implements ``equation`` and nothing else.

    Items are for example obstacles; numbers that all items have in common, such as the robot's body, are ``shared``.
    The equation is recorded once with tracing numbers, so it must not branch on a number (use ``operations.where``).
    The recording is evaluated for floats and arrays, and differentiated; no gradient is written by hand.

    Example: any number of discs (x, y, radius) in the plane.

        >>> class Discs(safedpa.AbstractEquationBarrier):
        ...     kind, numbers = "obstacle", 3
        ...     def __init__(self, discs):
        ...         self.each, self.names = tuple(discs), tuple(f"disc {i}" for i in range(len(discs)))
        ...     @staticmethod
        ...     def equation(given, operations):
        ...         x, y, radius = given.each
        ...         return [operations.sqrt((given.state[0] - x) ** 2 + (given.state[1] - y) ** 2) - radius]
        >>> Discs([(3.0, 4.0, 1.0), (0.0, 2.0, 0.5)]).h(np.array([0.0, 0.0]))
        array([4. , 1.5])
    """

    shared: tuple[float, ...] = ()
    """Numbers that all items have in common."""
    each: tuple[tuple[float, ...], ...]
    """(items, numbers) the numbers of each item."""
    numbers: int
    """Numbers per item, also if there is no item."""
    form: tuple[int, ...] = ()
    """Integers that select a variant of the equation; see ``Given``."""

    @staticmethod
    @abstractmethod
    def equation(given: Given, operations: Operations) -> Sequence[Scalar]:
        """h of one item, (rows,), in a unit of the barrier's own choice."""

    @staticmethod
    def grad_bound(given: Given, operations: Operations) -> Sequence[Scalar] | None:
        """Returns an upper bound (states,) of |d(h)/d(x_j)| for every item; None: not known.

        With it the filter skips the gradients of rows that no action can violate.
        """
        return None

    def h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return np.array(self.scalar_rows(len(state)).h_floats(state.tolist()))

    def h_and_grad(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: D102
        rows, plain = self.scalar_rows(len(state)), state.tolist()
        h = np.array(rows.h_floats(plain))
        return h, np.array(rows.grad_h_floats(plain, range(len(h)))).reshape(len(h), len(state))

    def with_shared(self, shared: tuple[float, ...]) -> Self:
        """A copy with other shared numbers, as many as before; nothing is checked again."""
        other = object.__new__(type(self))  # no call of __init__: subclasses have other parameters
        other.__dict__.update(self.__getstate__())
        other.shared = shared
        return other

    def with_items(self, each: Sequence[tuple[float, ...]], names: tuple[str, ...]) -> Self:
        """A copy with other items (items, numbers) and their names; nothing is checked again."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__getstate__())
        other.each, other.names = tuple(each), names
        return other

    def scalar_rows(self, states: int) -> Any:
        """Returns an evaluator of these items alone in Python floats: ``h_floats`` and the others."""
        # Cached in the instance and left out of pickles: compiled functions do not travel.
        known: dict[int, Any] = self.__dict__.setdefault("_rows", {})
        if states not in known:
            known[states] = rows_of(pattern_of((self,)), states)((self.shared,), (self.each,))
        return known[states]

    def __getstate__(self) -> dict[str, Any]:
        """Compiled functions cannot be pickled; the receiving process compiles them again."""
        return {name: value for name, value in self.__dict__.items() if name != "_rows"}


def pattern_of(parts: Sequence[AbstractEquationBarrier]) -> Pattern:
    """Returns what the recorded rows of these parts depend on, apart from numbers."""
    known: dict[tuple[float, ...], int] = {}
    found = []
    for number, part in enumerate(parts):
        # Parts with the same shared numbers, such as one robot body, compute what depends on them once.
        body = known.setdefault(part.shared, number) if part.shared else number
        found.append((type(part), len(part.shared), part.numbers, part.form, -1 if body == number else body))
    return tuple(found)


@cache
def tape_of(pattern: Pattern, states: int) -> RowTape:
    """The equations of a pattern, recorded for a state of so many entries."""
    groups = [
        RowGroup(kind.equation, shared, each, form, _bound(kind), body) for kind, shared, each, form, body in pattern
    ]
    return RowTape(states, groups)


@cache
def rows_of(pattern: Pattern, states: int) -> CompiledRows:
    """Returns what makes a pattern's rows over plain numbers from the numbers of a scene."""
    return CompiledRows(tape_of(pattern, states))


@cache
def batch_rows_of(pattern: Pattern, states: int) -> BatchRows:
    """The rows of a pattern over arrays with the robots first."""
    return BatchRows(tape_of(pattern, states))


def _bound(kind: type[AbstractEquationBarrier]) -> Equation | None:
    return None if kind.grad_bound is AbstractEquationBarrier.grad_bound else kind.grad_bound  # type: ignore[return-value]
