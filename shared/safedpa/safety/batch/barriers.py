"""Barriers of many robots at once, with the robots first in every array; ``BatchFilter`` uses them.

``CompiledBatchBarriers`` are equations, ``SequentialBarriers`` any barriers one robot after the other (the reference),
and ``BatchStopping`` is ``StoppingBarrier`` for many robots.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.equation import AbstractEquationBarrier, Pattern, batch_rows_of, pattern_of
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.barriers.stopping import (
    ALIKE,
    ENDS,
    NUDGE,
    Motion,
    StoppingBarrier,
    nearer_end,
    stopping_path,
    stopping_room,
)

__all__ = [
    "AbstractBatchBarriers",
    "BatchStopping",
    "CompiledBatchBarriers",
    "SequentialBarriers",
    "batch_barriers",
]


class AbstractBatchBarriers(ABC):
    """The same rows around each of many robots."""

    kinds: tuple[str, ...]
    """(rows,) the kind of each row."""
    reads: tuple[str, ...] = ()
    """As in ``AbstractBarrier``."""
    at_once: tuple[bool, ...] = ()
    """(rows,) as in ``AbstractBarrier``; empty: none."""

    @abstractmethod
    def __len__(self) -> int:
        """The number of robots."""

    @abstractmethod
    def only(self, which: IndexArray) -> AbstractBatchBarriers:
        """The barriers of the robots of these indices."""

    @abstractmethod
    def one(self, robot: int) -> Sequence[AbstractBarrier]:
        """The barriers of one robot, for the filter of one robot."""

    @abstractmethod
    def h(self, state: FloatArray) -> FloatArray:
        """h (robots, rows) at states (robots, states)."""

    @abstractmethod
    def lie_derivative(self, state: FloatArray, g: FloatArray, widths: FloatArray) -> FloatArray:
        """d(h)/d(a) (robots, rows, actions), if the states change by g (robots, states, actions) a.

        ``widths`` (actions,) are the actions' ranges, over which a difference quotient may be taken.
        """


@final
class CompiledBatchBarriers(AbstractBatchBarriers):
    """Barriers that are equations, compiled to one function over arrays.

    ``shared`` and ``each`` have, for each part of the ``pattern``, its shared numbers (robots, 1) and those of its
    items (robots, items). ``one`` makes the barriers of one robot by its index; ``reads`` as in ``AbstractBarrier``.
    """

    def __init__(
        self,
        pattern: Pattern,
        kinds: Sequence[str],
        states: int,
        shared: Sequence[Sequence[FloatArray]],
        each: Sequence[Sequence[FloatArray]],
        one: Callable[[int], Sequence[AbstractBarrier]],
        robots: int,
        reads: Sequence[str] = (),
    ) -> None:
        self.kinds, self._pattern, self._states = tuple(kinds), pattern, states
        self._shared, self._each = [list(part) for part in shared], [list(part) for part in each]
        self._one, self._index = one, np.arange(robots)
        self.reads = tuple(reads)

    @classmethod
    def of(cls, parts: Sequence[Sequence[AbstractEquationBarrier]], states: int) -> CompiledBatchBarriers:
        """From the barriers of each robot, all with the same kinds and item counts. Raises InputError for others."""
        # One function serves all robots, so the equations and the numbers of items must be the same.
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
        many.at_once = tuple(chain.from_iterable(part.at_once_rows for part in first))
        return many

    def __len__(self) -> int:
        return len(self._index)

    def only(self, which: IndexArray) -> CompiledBatchBarriers:  # noqa: D102
        # Without __init__: the parts are those of a batch that was checked when it was made.
        some = object.__new__(CompiledBatchBarriers)
        some.__dict__.update(self.__dict__)
        some._index = self._index[which]
        some._shared, some._each = (
            [[numbers[which] for numbers in part] for part in parts] for parts in (self._shared, self._each)
        )
        return some

    def one(self, robot: int) -> Sequence[AbstractBarrier]:  # noqa: D102
        # ``robot`` counts within this selection; ``_one`` expects the index of the whole batch.
        return self._one(int(self._index[robot]))

    def h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return batch_rows_of(self._pattern, self._states).h(state, self._shared, self._each)

    def grad_h(self, state: FloatArray) -> FloatArray:
        """d(h)/d(state) (robots, rows, states) at states (robots, states)."""
        return batch_rows_of(self._pattern, self._states).grad_h(state, self._shared, self._each)

    def lie_derivative(self, state: FloatArray, g: FloatArray, widths: FloatArray) -> FloatArray:  # noqa: D102
        return np.asarray(self.grad_h(state) @ g)


@final
class SequentialBarriers(AbstractBatchBarriers):
    """Barriers of any class, evaluated robot by robot: the reference."""

    def __init__(self, parts: Sequence[Sequence[AbstractBarrier]]) -> None:
        self._sets = [make_barrier_set(own) for own in parts]
        self.kinds = self._sets[0].kinds if self._sets else ()
        if any(barriers.kinds != self.kinds for barriers in self._sets):
            raise InputError("barriers: got others for one robot than for another, wanted as many of each for all")
        self.at_once = tuple(self._sets[0].at_once) if self._sets else ()
        if any(tuple(barriers.at_once) != self.at_once for barriers in self._sets):
            raise InputError("barriers: got some that may be used up at once for one robot and not for another")
        self.reads = next((part.reads for barriers in self._sets for part in barriers if part.reads), ())

    def __len__(self) -> int:
        return len(self._sets)

    def only(self, which: IndexArray) -> SequentialBarriers:  # noqa: D102
        some = object.__new__(SequentialBarriers)
        some.kinds, some.reads, some.at_once = self.kinds, self.reads, self.at_once
        some._sets = [self._sets[robot] for robot in which.tolist()]
        return some

    def one(self, robot: int) -> Sequence[AbstractBarrier]:  # noqa: D102
        return self._sets[robot]

    def h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        pairs = zip(self._sets, state.tolist(), strict=True)
        return np.array([barriers.h_floats(own) for barriers, own in pairs]).reshape(len(state), len(self.kinds))

    def lie_derivative(self, state: FloatArray, g: FloatArray, widths: FloatArray) -> FloatArray:  # noqa: D102
        rows, plain = range(len(self.kinds)), widths.tolist()
        every = zip(self._sets, state.tolist(), g.tolist(), strict=True)
        # Row by row for all robots alike: the reference must not share code with the compiled batch.
        found = [barriers.lie_derivative_floats(own, motion, plain, rows) for barriers, own, motion in every]
        return np.array(found).reshape(len(state), len(self.kinds), len(widths))


def batch_barriers(parts: Sequence[Sequence[AbstractBarrier]], states: int) -> AbstractBatchBarriers:
    """The fastest batch of these barriers: one compiled function if all are equations, else robot by robot."""
    own: Any = [list(one) for one in parts]
    if own and all(isinstance(part, AbstractEquationBarrier) for one in own for part in one):
        return CompiledBatchBarriers.of(own, states)
    return SequentialBarriers(parts)


@final
class BatchStopping(AbstractBatchBarriers):
    """h (robots, hazards) among ``hazards`` (robots, m, 3): x, y, radius [m]; ``motion`` as in ``stopping_path``."""

    reads = StoppingBarrier.reads

    def __init__(self, hazards: FloatArray, motion: Motion) -> None:
        self.hazards, self._motion = hazards, motion
        self.kinds = (StoppingBarrier.kind,) * hazards.shape[1]

    def __len__(self) -> int:
        return len(self.hazards)

    def only(self, which: IndexArray) -> BatchStopping:  # noqa: D102
        return BatchStopping(self.hazards[which], self._motion.of(which))

    def one(self, robot: int) -> Sequence[AbstractBarrier]:  # noqa: D102
        return [StoppingBarrier(self.hazards[robot], self._motion.of(robot))]

    def motion_of(self, robot: int) -> Motion:
        """The motion parameters of that robot."""
        return self._motion.of(robot)

    def h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return self.best(state)[0]

    def best(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """h (robots, hazards) with the end first that has more clearance, and that end (robots,)."""
        every_robot = np.arange(len(state))
        both = np.concatenate((every_robot, every_robot))
        # Both ends in one call: the path computation takes nearly as long for half as many robots.
        rooms = self._rooms(state[both], both, np.repeat(ENDS, len(state)))
        first, second = rooms[: len(state)], rooms[len(state) :]
        # Without hazards there is no minimum; either end is then as good.
        more = second.min(axis=1) - first.min(axis=1) if rooms.shape[1] else np.zeros(len(state))
        # Equal clearance within a micrometre would otherwise flip between the ends by rounding.
        nose = np.where(np.abs(more) > ALIKE, more < 0.0, nearer_end(state.T, self._motion) > 0.0)
        return np.where(nose[:, np.newaxis], first, second), np.where(nose, *ENDS)

    def lie_derivative(self, state: FloatArray, g: FloatArray, widths: FloatArray) -> FloatArray:  # noqa: D102
        robots, states = state.shape
        _, end = self.best(state)
        around = np.repeat(state[:, np.newaxis], 2 * states, axis=1)
        index = np.arange(states)
        around[:, index, index] += NUDGE
        around[:, states + index, index] -= NUDGE
        # The end stays that of the centre, as for one robot: the gradient belongs to one manoeuvre.
        which = np.repeat(np.arange(robots), 2 * states)
        rooms = self._rooms(around.reshape(-1, states), which, end[which]).reshape(robots, 2, states, -1)
        gradient = (rooms[:, 0] - rooms[:, 1]).swapaxes(1, 2) / (2.0 * NUDGE)
        return np.asarray(gradient @ g)

    def _rooms(self, state: FloatArray, which: IndexArray, end: FloatArray) -> FloatArray:
        """h (n, hazards) at states (n, states) of the robots ``which``, for manoeuvres with those ends first."""
        hazards = self.hazards[which]
        path = stopping_path(state.T, self._motion.of(which), end)
        return stopping_room(path, hazards[..., :2], hazards[..., 2])
