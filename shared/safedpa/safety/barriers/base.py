"""A barrier: h(x) >= 0 describes the safe set; one object may hold many of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from operator import is_
from typing import Any, Final, NamedTuple, final, overload

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.equations.chain_rule import chain_rule
from safedpa.errors import InputError
from safedpa.safety.barriers.cache import BarrierValueCache
from safedpa.safety.validation import checked_output

__all__ = ["AbstractBarrier", "AbstractBarrierSet", "Barriers", "CachingBarrierSet"]


_GRADIENT: Final = "gradient of h"


class AbstractBarrier(ABC):
    """m functions h_i(x) >= 0 of the state x (states,), in a unit of the barrier's own choice."""

    kind: str
    """Which margin applies: ``obstacle``, ``field``, ``speed`` or a name of the user's own."""
    names: tuple[str, ...]
    """(m,) what each of them is called in verdicts."""
    reads: tuple[str, ...] = ()
    """Names of the entries of the state that h is written for, from the first on; empty: not known.

    A filter refuses a model whose states are others.
    """
    at_once: bool = False
    """Whether one step may use up all of h, down to the margin, and not only the share eta of the settings: of a
    barrier whose h counts on the worst already, and would hold a robot back from what is far from it."""

    @abstractmethod
    def values(self, state: FloatArray) -> FloatArray:
        """h (m,) at ``state`` (states,)."""

    @abstractmethod
    def evaluate(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """h (m,) and its gradient d(h_i)/d(x_j) (m, states) at ``state`` (states,)."""

    def since(self, state: FloatArray) -> AbstractBarrier:
        """The barrier for states that one tick leads to from ``state``, with the same names.

        One that knows what lies between the two overrides it.
        """
        return self

    def along(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """d(h_i)/d(u_j) (m, n) at ``state`` + ``directions`` (states, n) u, u = 0."""
        return np.asarray(checked_output("gradient of h", self.evaluate(state)[1]) @ directions)


class _Order(NamedTuple):
    """What follows from names and kinds of the parts of a stack alone."""

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    at_once: list[bool]
    rows: Mapping[str, tuple[int, ...]]
    runs: tuple[tuple[str, int], ...]
    """Kind and number of barriers of each part."""

    @classmethod
    def of(cls, parts: Sequence[AbstractBarrier]) -> _Order:
        runs = tuple([(part.kind, len(part.names)) for part in parts])
        names, kinds, at_once = list[str](), list[str](), list[bool]()
        rows: dict[str, tuple[int, ...]] = {}
        for part in parts:
            count = len(part.names)
            if count:
                rows[part.kind] = (*rows.get(part.kind, ()), *range(len(names), len(names) + count))
            names += part.names
            kinds += [part.kind] * count
            at_once += [part.at_once] * count
        return cls(tuple(names), tuple(kinds), at_once, rows, runs)


class AbstractBarrierSet(Sequence[AbstractBarrier]):
    """Several barriers, side by side: h stacked in the order given; as a sequence, the barriers themselves.

    ``like``: a stack whose parts have these names and kinds in this order; what follows from them alone is taken over.
    """

    def __init__(self, parts: Sequence[AbstractBarrier], like: AbstractBarrierSet | None = None) -> None:
        self.parts = tuple(parts)
        order: _Order = _Order.of(self.parts) if like is None else like._order
        self._order: _Order = order
        self.names, self.kinds = order.names, order.kinds
        """(m,) each."""
        self.at_once: list[bool] = order.at_once
        """(m,) whether one step may use up all of h."""
        self.rows = order.rows
        """By kind of barrier: where its values stand."""

    def __len__(self) -> int:
        return len(self.parts)

    @overload
    def __getitem__(self, index: int) -> AbstractBarrier: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[AbstractBarrier, ...]: ...

    def __getitem__(self, index: int | slice) -> AbstractBarrier | tuple[AbstractBarrier, ...]:
        return self.parts[index]

    @abstractmethod
    def values(self, state: FloatArray) -> FloatArray:
        """h (m,) of all parts at ``state`` (states,)."""

    @abstractmethod
    def gradient(self, state: FloatArray) -> FloatArray:
        """d(h_i)/d(x_j) (m, states) of all parts at ``state`` (states,)."""

    def heights(self, state: Sequence[float]) -> list[float]:
        """``values`` for plain numbers: h (m,) at ``state`` (states,)."""
        h: list[float] = _plain("h", self.values(_unwritten(state)), (len(self.names),))
        return h

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> Sequence[Sequence[float]]:
        """``gradient`` for plain numbers: its rows of these indices."""
        table = _plain("gradient of h", self.gradient(_unwritten(state)), (len(self.names), len(state)))
        return [table[row] for row in rows]

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """d(h_i)/d(a_j) (rows, actions) of the rows of these indices, where the state moves by g (states, actions) a.

        ``widths`` (actions,) are the actions' ranges: over what a slope may be measured.
        """
        return chain_rule(self.slopes(state, rows), g)

    def steepest(self, state: Sequence[float]) -> Sequence[float] | None:
        """(states,) what no |d(h_i)/d(x_j)| at ``state`` exceeds, for any row i; None where that is not known."""
        return None

    def plain(self, states: int) -> Any:
        """What has ``heights``, ``slopes``, ``along`` and ``steepest`` of so many states, by the shortest way."""
        return self

    def since(self, state: Sequence[float]) -> AbstractBarrierSet:
        """The stack for states that one tick leads to from ``state``: itself where no part looks between the two."""
        return self

    @property
    def one_by_one(self) -> Barriers:
        """The reference for these parts."""
        return Barriers(self.parts)

    def of_each(self, by_kind: Mapping[str, float], otherwise: float) -> list[float]:
        """(m,) the number that belongs to each barrier's kind."""
        numbers: list[float] = []
        for kind, count in self._order.runs:
            numbers += [float(by_kind.get(kind, otherwise))] * count
        return numbers


@final
class Barriers(AbstractBarrierSet):
    """The parts one by one: the reference, and what serves barriers of any kind."""

    def values(self, state: FloatArray) -> FloatArray:  # noqa: D102
        if len(self.parts) == 1:
            return checked_output("h", self.parts[0].values(state))
        return np.concatenate([_of_part("h", part, part.values(state)) for part in self.parts])

    def gradient(self, state: FloatArray) -> FloatArray:  # noqa: D102
        if len(self.parts) == 1:
            return checked_output(_GRADIENT, self.parts[0].evaluate(state)[1])
        states = len(state)
        return np.concatenate([_of_part(_GRADIENT, part, part.evaluate(state)[1], states) for part in self.parts])

    def since(self, state: Sequence[float]) -> AbstractBarrierSet:  # noqa: D102
        parts = [part.since(np.array(state)) for part in self.parts]
        return self if all(map(is_, parts, self.parts)) else Barriers(parts)

    def along(  # noqa: D102
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        at, whole = _unwritten(state), np.array(g) * widths  # of the whole range: as large as any motion by an action
        found = [_of_part(_GRADIENT, part, part.along(at, whole), len(widths)) for part in self.parts]
        slopes = np.concatenate(found) / widths
        table = _plain(_GRADIENT, slopes, (len(self.names), len(widths)))
        return [table[row] for row in rows]


@final
class CachingBarrierSet(AbstractBarrierSet):
    """Another stack, with h at the last few states remembered: within one tick the same states come up again.

    A prediction is judged when the action is decided, and again next to the measured state when the margin is watched.
    The lists that it hands out are shared: no one may write into them.
    """

    def __init__(self, stack: AbstractBarrierSet) -> None:
        super().__init__(stack.parts, stack)
        self._stack = stack
        self._plain: dict[int, BarrierValueCache] = {}

    def values(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return np.array(self.heights(state.tolist()))

    def gradient(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return self._stack.gradient(state)

    def heights(self, state: Sequence[float]) -> list[float]:  # noqa: D102
        return self.plain(len(state)).heights(state)

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> Sequence[Sequence[float]]:  # noqa: D102
        return self._stack.slopes(state, rows)

    def along(  # noqa: D102
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        return self._stack.along(state, g, widths, rows)

    def steepest(self, state: Sequence[float]) -> Sequence[float] | None:  # noqa: D102
        return self._stack.steepest(state)

    def since(self, state: Sequence[float]) -> AbstractBarrierSet:  # noqa: D102
        found = self._stack.since(state)
        return self if found is self._stack else found

    def plain(self, states: int) -> BarrierValueCache:  # noqa: D102
        known = self._plain.get(states)
        if known is None:
            known = self._plain[states] = BarrierValueCache(self._stack.plain(states))
        return known


def _unwritten(state: Sequence[float]) -> FloatArray:
    """What every part may read and none may write into: the next one would see it."""
    array = np.array(state)
    array.setflags(write=False)
    return array


def _of_part(what: str, part: AbstractBarrier, value: Any, *columns: int) -> FloatArray:
    """What one part returned, one row for each of its names: else the next part's rows would be read as others."""
    array, wanted = checked_output(what, value), (len(part.names), *columns)
    if array.shape != wanted:
        raise InputError(f"{what} of barrier {', '.join(part.names)}: got shape {array.shape}, wanted {wanted}")
    return array


def _plain(what: str, array: FloatArray, shape: tuple[int, ...]) -> Any:
    if array.shape != shape:
        raise InputError(f"{what}: got shape {array.shape}, wanted {shape}")
    return array.tolist()
