"""Barriers of many robots at once, the robots first: what ``BatchFilter`` asks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.equation_barrier import AbstractEquationBarrier, Pattern, many_rows_of, pattern_of
from safedpa.safety.stacks import stacked

__all__ = ["AbstractManyBarriers", "ManyEquations", "OneByOne", "many_barriers"]

Values = NDArray[np.float64]
Indices = NDArray[np.intp]


class AbstractManyBarriers(ABC):
    """The same rows around each of many robots."""

    kinds: tuple[str, ...]
    """(rows,) the kind of barrier that each row belongs to."""
    reads: tuple[str, ...] = ()
    """As in ``AbstractBarrier``."""
    at_once: tuple[bool, ...] = ()
    """(rows,) as in ``AbstractBarrier``; empty: none."""

    @abstractmethod
    def __len__(self) -> int:
        """How many robots."""

    @abstractmethod
    def only(self, which: Indices) -> AbstractManyBarriers:
        """Those of the robots of these indices."""

    @abstractmethod
    def one(self, robot: int) -> Sequence[AbstractBarrier]:
        """The same barriers of one robot, for the filter of one robot."""

    @abstractmethod
    def values(self, state: Values) -> Values:
        """h (robots, rows) at states (robots, states)."""

    @abstractmethod
    def along(self, state: Values, g: Values, widths: Values) -> Values:
        """d(h)/d(a) (robots, rows, actions) where the states move by g (robots, states, actions) a.

        ``widths`` (actions,) are the actions' ranges: over what a slope may be measured.
        """


@final
class ManyEquations(AbstractManyBarriers):
    """Barriers that are equations, in one function over arrays.

    ``shared`` and ``each`` by part of the ``pattern``: its shared numbers (robots, 1) each, its items' (robots, items)
    each. ``one`` makes the barriers of one robot, by its index; ``reads`` as in ``AbstractBarrier``.
    """

    def __init__(
        self,
        pattern: Pattern,
        kinds: Sequence[str],
        states: int,
        shared: Sequence[Sequence[Values]],
        each: Sequence[Sequence[Values]],
        one: Callable[[int], Sequence[AbstractBarrier]],
        robots: int,
        reads: Sequence[str] = (),
    ) -> None:
        self.kinds, self._pattern, self._states = tuple(kinds), pattern, states
        self._shared, self._each = [list(part) for part in shared], [list(part) for part in each]
        self._one, self._index = one, np.arange(robots)
        self.reads = tuple(reads)

    @classmethod
    def of(cls, parts: Sequence[Sequence[AbstractEquationBarrier]], states: int) -> ManyEquations:
        """From the barriers of each robot, all of the same kinds with as many items. Raises InputError for others."""
        patterns = {pattern_of(own) for own in parts}
        counts = {tuple(len(part.each) for part in own) for own in parts}
        if len(patterns) != 1 or len(counts) != 1:
            raise InputError("barriers: got others for one robot than for another, wanted as many of each for all")
        first = parts[0]
        shared = [
            [np.array([[own[n].shared[i]] for own in parts]) for i in range(len(part.shared))]
            for n, part in enumerate(first)
        ]
        each = [
            [np.array([[item[i] for item in own[n].each] for own in parts]) for i in range(part.numbers)]
            for n, part in enumerate(first)
        ]
        kinds = list(chain.from_iterable([part.kind] * len(part.names) for part in first))
        reads = next((part.reads for own in parts for part in own if part.reads), ())
        many = cls(next(iter(patterns)), kinds, states, shared, each, lambda robot: parts[robot], len(parts), reads)
        many.at_once = tuple(chain.from_iterable([part.at_once] * len(part.names) for part in first))
        return many

    def __len__(self) -> int:
        return len(self._index)

    def only(self, which: Indices) -> ManyEquations:  # noqa: D102
        some = object.__new__(ManyEquations)
        some.__dict__.update(self.__dict__)
        some._index = self._index[which]
        some._shared, some._each = (
            [[numbers[which] for numbers in part] for part in parts] for parts in (self._shared, self._each)
        )
        return some

    def one(self, robot: int) -> Sequence[AbstractBarrier]:  # noqa: D102
        return self._one(int(self._index[robot]))

    def values(self, state: Values) -> Values:  # noqa: D102
        return many_rows_of(self._pattern, self._states).heights(state, self._shared, self._each)

    def gradient(self, state: Values) -> Values:
        """d(h)/d(state) (robots, rows, states) at states (robots, states)."""
        return many_rows_of(self._pattern, self._states).slopes(state, self._shared, self._each)

    def along(self, state: Values, g: Values, widths: Values) -> Values:  # noqa: D102
        return np.asarray(self.gradient(state) @ g)


@final
class OneByOne(AbstractManyBarriers):
    """Barriers of any kind, asked robot by robot: the reference."""

    def __init__(self, parts: Sequence[Sequence[AbstractBarrier]]) -> None:
        self._stacks = [stacked(own) for own in parts]
        self.kinds = self._stacks[0].kinds if self._stacks else ()
        if any(stack.kinds != self.kinds for stack in self._stacks):
            raise InputError("barriers: got others for one robot than for another, wanted as many of each for all")
        self.at_once = tuple(self._stacks[0].at_once) if self._stacks else ()
        if any(tuple(stack.at_once) != self.at_once for stack in self._stacks):
            raise InputError("barriers: got some that may be used up at once for one robot and not for another")
        self.reads = next((part.reads for stack in self._stacks for part in stack if part.reads), ())

    def __len__(self) -> int:
        return len(self._stacks)

    def only(self, which: Indices) -> OneByOne:  # noqa: D102
        some = object.__new__(OneByOne)
        some.kinds, some.reads, some.at_once = self.kinds, self.reads, self.at_once
        some._stacks = [self._stacks[robot] for robot in which.tolist()]
        return some

    def one(self, robot: int) -> Sequence[AbstractBarrier]:  # noqa: D102
        return self._stacks[robot]

    def values(self, state: Values) -> Values:  # noqa: D102
        pairs = zip(self._stacks, state.tolist(), strict=True)
        return np.array([stack.heights(own) for stack, own in pairs]).reshape(len(state), len(self.kinds))

    def along(self, state: Values, g: Values, widths: Values) -> Values:  # noqa: D102
        rows, plain = range(len(self.kinds)), widths.tolist()
        every = zip(self._stacks, state.tolist(), g.tolist(), strict=True)
        found = [stack.along(own, motion, plain, rows) for stack, own, motion in every]
        return np.array(found).reshape(len(state), len(self.kinds), len(widths))


def many_barriers(parts: Sequence[Sequence[AbstractBarrier]], states: int) -> AbstractManyBarriers:
    """The quickest way to ask the barriers of each robot: in one function where all are equations, else one by one."""
    own: Any = [list(one) for one in parts]
    if own and all(isinstance(part, AbstractEquationBarrier) for one in own for part in one):
        return ManyEquations.of(own, states)
    return OneByOne(parts)
