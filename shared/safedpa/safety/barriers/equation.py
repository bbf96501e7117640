"""A barrier whose h is one equation over ``Operations``: values, slopes and batches come from recording it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import Any, ClassVar, Self

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.equations.given import Given
from safedpa.equations.many_rows import ManyRows
from safedpa.equations.plain_rows import plain_rows
from safedpa.equations.rows import Equation, RowGroup, RowTape
from safedpa.operations import Operations, Scalar
from safedpa.safety.barriers.base import AbstractBarrier

__all__ = ["AbstractEquationBarrier", "Pattern", "many_rows_of", "pattern_of", "rows_of", "tape_of", "written_key"]


Pattern = tuple[tuple[type["AbstractEquationBarrier"], int, int, tuple[int, ...], int], ...]
"""Of each part its class, how many numbers its items have in common, how many each has, its form, and the first part
with the same shared numbers, or -1."""


class AbstractEquationBarrier(AbstractBarrier):
    """h_i(x) >= 0 for i = 1..m items, of which each gives one or more rows: write ``h``, and nothing else.

    Obstacles are items; what all have in common, the robot's body say, is ``shared``. The equation is run once with
    numbers that write down what is done to them, so it must not branch on a number (``operations.where`` chooses), and
    does for floats, for arrays and for slopes what stands there. No gradient is written by hand.
    """

    shared: tuple[float, ...] = ()
    """Numbers that all items have in common."""
    each: tuple[tuple[float, ...], ...]
    """(items, numbers) what tells one item from the next."""
    numbers: int
    """How many numbers an item has, whether or not there is any item."""
    form: tuple[int, ...] = ()
    """Whole numbers that the equation itself depends on; see ``Given``."""
    written: ClassVar[str] = ""
    """Module in which the rows of this equation stand, recorded ahead of time and compiled with the rest."""

    @staticmethod
    @abstractmethod
    def h(given: Given, operations: Operations) -> Sequence[Scalar]:
        """h of one item, (rows,), in a unit of the barrier's own choice."""

    @staticmethod
    def steepest(given: Given, operations: Operations) -> Sequence[Scalar] | None:
        """(states,) what no |d(h)/d(x_j)| exceeds, whatever the item; None: not known.

        It spares the slopes of rows that no action can break.
        """
        return None

    def values(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return np.array(self.alone(len(state)).heights(state.tolist()))

    def evaluate(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: D102
        rows, plain = self.alone(len(state)), state.tolist()
        h = np.array(rows.heights(plain))
        return h, np.array(rows.slopes(plain, range(len(h)))).reshape(len(h), len(state))

    def sharing(self, shared: tuple[float, ...]) -> Self:
        """The same items with other numbers in common, as many as before; nothing is checked again."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__getstate__())
        other.shared = shared
        return other

    def holding(self, each: Sequence[tuple[float, ...]], names: tuple[str, ...]) -> Self:
        """Other items (items, numbers) with the same numbers in common, and their names; nothing is checked again."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__getstate__())
        other.each, other.names = tuple(each), names
        return other

    def alone(self, states: int) -> Any:
        """h and slopes of these items over plain numbers (``heights``, ``slopes``, ``steepest``), of so many states."""
        known: dict[int, Any] = self.__dict__.setdefault("_rows", {})
        if states not in known:
            known[states] = rows_of(pattern_of((self,)), states)((self.shared,), (self.each,))
        return known[states]

    def __getstate__(self) -> dict[str, Any]:
        """Functions made here do not travel to another process; they are made there again."""
        return {name: value for name, value in self.__dict__.items() if name != "_rows"}


def pattern_of(parts: Sequence[AbstractEquationBarrier]) -> Pattern:
    """What the recorded rows of these parts depend on, next to numbers."""
    known: dict[tuple[float, ...], int] = {}
    found = []
    for number, part in enumerate(parts):
        body = known.setdefault(part.shared, number) if part.shared else number
        found.append((type(part), len(part.shared), part.numbers, part.form, -1 if body == number else body))
    return tuple(found)


@cache
def tape_of(pattern: Pattern, states: int) -> RowTape:
    """The equations of a pattern, recorded for a state of so many entries."""
    groups = [RowGroup(kind.h, shared, each, form, _bound(kind), body) for kind, shared, each, form, body in pattern]
    return RowTape(states, groups)


@cache
def rows_of(pattern: Pattern, states: int) -> Any:
    """The class of the rows of a pattern over plain numbers: written ahead of time where it is, else made now."""
    for module in {kind.written for kind, *_ in pattern} - {""}:
        known = import_module(module).WRITTEN.get(written_key(pattern, states))
        if known is not None:
            return known
    return plain_rows(tape_of(pattern, states))


@cache
def many_rows_of(pattern: Pattern, states: int) -> ManyRows:
    """The rows of a pattern over arrays with the robots first."""
    return ManyRows(tape_of(pattern, states))


def written_key(pattern: Pattern, states: int) -> str:
    """The name under which the rows of a pattern are written ahead of time."""
    parts = [f"{kind.__qualname__} {shared} {each} {form} {body}" for kind, shared, each, form, body in pattern]
    return f"{states}: {', '.join(parts)}"


def _bound(kind: type[AbstractEquationBarrier]) -> Equation | None:
    return None if kind.steepest is AbstractEquationBarrier.steepest else kind.steepest  # type: ignore[return-value]
