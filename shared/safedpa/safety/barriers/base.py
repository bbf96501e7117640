"""The barrier interface: h(x) >= 0 describes the safe set; one object may hold many such functions.

Vocabulary of the whole package: ``h`` (values), ``grad_h`` (d(h)/d(x)), ``lie_derivative`` (d(h)/d(x) g) and
``grad_bound`` (a bound of |d(h)/d(x)|). Without a suffix they take and return arrays, with ``_floats`` Python floats.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from operator import is_
from typing import Any, Final, NamedTuple, final, overload

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.equations.chain_rule import chain_rule
from safedpa.errors import InputError
from safedpa.result import one_line
from safedpa.safety.barriers.cache import BarrierValueCache
from safedpa.safety.validation import checked_output

__all__ = ["AbstractBarrier", "AbstractBarrierSet", "Barriers", "CachingBarrierSet"]


_GRADIENT: Final = "gradient of h"


class AbstractBarrier(ABC):
    """m functions h_i(x) >= 0 of the state x (states,), in a unit of the barrier's choice.

    A subclass has ``kind``, ``names`` and the two methods ``h`` and ``h_and_grad``; for a single function,
    ``FunctionBarrier`` needs no class.

    Example:

        >>> class Wall(safedpa.AbstractBarrier):
        ...     kind, names = "wall", ("wall",)
        ...     def h(self, state):
        ...         return 1.0 - state[:1]
        ...     def h_and_grad(self, state):
        ...         return self.h(state), np.array([[-1.0, 0.0]])
        >>> Wall().h(np.array([0.25, 0.0]))
        array([0.75])
    """

    kind: str
    """Selects the margin: ``obstacle``, ``field``, ``speed`` or a name that the user chooses."""
    names: tuple[str, ...]
    """(m,) names that verdicts use."""
    reads: tuple[str, ...] = ()
    """Names of the state entries that h is written for, from the first on; empty: not known.

    A filter refuses a model with other states.
    """
    at_once: bool | tuple[bool, ...] = False
    """Whether one step may use up all of h, down to the margin, instead of the share eta: for a barrier whose h assumes
    the worst case already, and would otherwise slow a robot down far away from an obstacle. A tuple: for each row."""

    @property
    def at_once_rows(self) -> tuple[bool, ...]:
        """(m,) ``at_once`` of each row."""
        return self.at_once if isinstance(self.at_once, tuple) else (self.at_once,) * len(self.names)

    def __repr__(self) -> str:
        return one_line(type(self).__name__, {"kind": self.kind, "names": ", ".join(self.names)})

    @abstractmethod
    def h(self, state: FloatArray) -> FloatArray:
        """Returns h (m,) at ``state`` (states,)."""

    @abstractmethod
    def h_and_grad(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns h (m,) and its gradient d(h_i)/d(x_j) (m, states) at ``state`` (states,)."""

    def starting_at(self, state: FloatArray) -> AbstractBarrier:
        """Returns the barrier for states that one tick leads to from ``state``, with the same names.

        Overridden by a barrier that evaluates the path between the two states.
        """
        return self

    def lie_derivative(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """Returns d(h_i)/d(u_j) (m, n) at ``state`` + ``directions`` (states, n) u, u = 0."""
        return np.asarray(checked_output("gradient of h", self.h_and_grad(state)[1]) @ directions)


class _Layout(NamedTuple):
    """Names, kinds and rows of the parts; computed once and shared by sets with the same parts."""

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    at_once: list[bool]
    rows: Mapping[str, tuple[int, ...]]
    runs: tuple[tuple[str, int], ...]
    """Kind and number of rows of each part."""

    @classmethod
    def of(cls, parts: Sequence[AbstractBarrier]) -> _Layout:
        runs = tuple([(part.kind, len(part.names)) for part in parts])
        names, kinds, at_once = list[str](), list[str](), list[bool]()
        rows: dict[str, tuple[int, ...]] = {}
        for part in parts:
            count = len(part.names)
            # An empty part has no rows, and its kind must not appear: a margin for it would look as if it were in use.
            if count:
                rows[part.kind] = (*rows.get(part.kind, ()), *range(len(names), len(names) + count))
            names += part.names
            kinds += [part.kind] * count
            at_once += part.at_once_rows
        return cls(tuple(names), tuple(kinds), at_once, rows, runs)


class AbstractBarrierSet(Sequence[AbstractBarrier]):
    """Several barriers with their h stacked in the given order; as a sequence, the barriers themselves.

    ``like``: a set whose parts have the same names and kinds in the same order; its layout is reused.
    """

    def __init__(self, parts: Sequence[AbstractBarrier], like: AbstractBarrierSet | None = None) -> None:
        self.parts = tuple(parts)
        # Reused from tick to tick: names and kinds of hundreds of rows change only when the scene does.
        layout: _Layout = _Layout.of(self.parts) if like is None else like._layout
        self._layout: _Layout = layout
        self.names, self.kinds = layout.names, layout.kinds
        """(m,) names and kinds of the rows."""
        self.at_once: list[bool] = layout.at_once
        """(m,) whether one step may use up all of h."""
        self.rows = layout.rows
        """Indices of the rows by kind of barrier."""

    def __len__(self) -> int:
        return len(self.parts)

    @overload
    def __getitem__(self, index: int) -> AbstractBarrier: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[AbstractBarrier, ...]: ...

    def __getitem__(self, index: int | slice) -> AbstractBarrier | tuple[AbstractBarrier, ...]:
        return self.parts[index]

    @abstractmethod
    def h(self, state: FloatArray) -> FloatArray:
        """Returns h (m,) of all parts at ``state`` (states,)."""

    @abstractmethod
    def grad_h(self, state: FloatArray) -> FloatArray:
        """Returns d(h_i)/d(x_j) (m, states) of all parts at ``state`` (states,)."""

    def h_floats(self, state: Sequence[float]) -> list[float]:
        """``h`` in Python floats: h (m,) at ``state`` (states,)."""
        h: list[float] = _checked_list("h", self.h(_read_only_array(state)), (len(self.names),))
        return h

    def grad_h_floats(self, state: Sequence[float], rows: Sequence[int]) -> Sequence[Sequence[float]]:
        """``grad_h`` in Python floats, restricted to ``rows``."""
        table = _checked_list("gradient of h", self.grad_h(_read_only_array(state)), (len(self.names), len(state)))
        return [table[row] for row in rows]

    def lie_derivative_floats(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """Returns d(h_i)/d(a_j) (rows, actions) of ``rows``, if the state changes by g (states, actions) a.

        ``widths`` (actions,) are the actions' ranges, over which a difference quotient may be taken.
        """
        return chain_rule(self.grad_h_floats(state, rows), g)

    def grad_bound(self, state: Sequence[float]) -> Sequence[float] | None:
        """Returns an upper bound (states,) of |d(h_i)/d(x_j)| at ``state`` for every row i; None if not known."""
        return None

    def scalar_rows(self, states: int) -> Any:
        """Returns the fastest evaluator in Python floats for this number of states: ``h_floats`` and the others."""
        return self

    def starting_at(self, state: Sequence[float]) -> AbstractBarrierSet:
        """Returns the set for states that one tick leads to from ``state``; itself if no part evaluates the path."""
        return self

    @property
    def sequential(self) -> Barriers:
        """The reference implementation for these parts: one by one."""
        return Barriers(self.parts)

    def per_row(self, by_kind: Mapping[str, float], otherwise: float) -> list[float]:
        """Returns (m,) for each row the number of its kind, or ``otherwise``."""
        numbers: list[float] = []
        # One look-up for each part instead of each row.
        for kind, count in self._layout.runs:
            numbers += [float(by_kind.get(kind, otherwise))] * count
        return numbers


@final
class Barriers(AbstractBarrierSet):
    """The parts evaluated one by one: the reference implementation, which accepts barriers of any class."""

    def h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        # A single part needs no copy by ``concatenate``, and its shape is checked by the caller.
        if len(self.parts) == 1:
            return checked_output("h", self.parts[0].h(state))
        return np.concatenate([_of_part("h", part, part.h(state)) for part in self.parts])

    def grad_h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        if len(self.parts) == 1:
            return checked_output(_GRADIENT, self.parts[0].h_and_grad(state)[1])
        states = len(state)
        return np.concatenate([_of_part(_GRADIENT, part, part.h_and_grad(state)[1], states) for part in self.parts])

    def starting_at(self, state: Sequence[float]) -> AbstractBarrierSet:  # noqa: D102
        parts = [part.starting_at(np.array(state)) for part in self.parts]
        # The same object if nothing changes: callers keep compiled evaluators and caches by identity.
        return self if all(map(is_, parts, self.parts)) else Barriers(parts)

    def lie_derivative_floats(  # noqa: D102
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        # Scaled to the whole action range, so that a difference quotient takes a step of the size of a real motion.
        point, whole_range = _read_only_array(state), np.array(g) * widths
        found = [_of_part(_GRADIENT, part, part.lie_derivative(point, whole_range), len(widths)) for part in self.parts]
        derivatives = np.concatenate(found) / widths
        table = _checked_list(_GRADIENT, derivatives, (len(self.names), len(widths)))
        return [table[row] for row in rows]


@final
class CachingBarrierSet(AbstractBarrierSet):
    """Another set with a cache of h at the last few states.

    Within one tick the same states recur: a prediction is evaluated when the action is decided, and again when the
    online margin compares it with the measured state. The returned lists are shared and must not be changed.
    """

    def __init__(self, barriers: AbstractBarrierSet) -> None:
        super().__init__(barriers.parts, barriers)
        self._wrapped = barriers
        self._by_size: dict[int, BarrierValueCache] = {}

    def h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return np.array(self.h_floats(state.tolist()))

    def grad_h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return self._wrapped.grad_h(state)

    def h_floats(self, state: Sequence[float]) -> list[float]:  # noqa: D102
        return self.scalar_rows(len(state)).h_floats(state)

    def grad_h_floats(self, state: Sequence[float], rows: Sequence[int]) -> Sequence[Sequence[float]]:  # noqa: D102
        return self._wrapped.grad_h_floats(state, rows)

    def lie_derivative_floats(  # noqa: D102
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        return self._wrapped.lie_derivative_floats(state, g, widths, rows)

    def grad_bound(self, state: Sequence[float]) -> Sequence[float] | None:  # noqa: D102
        return self._wrapped.grad_bound(state)

    def starting_at(self, state: Sequence[float]) -> AbstractBarrierSet:  # noqa: D102
        found = self._wrapped.starting_at(state)
        # A set that depends on the origin is valid for one decision only: caching it would not pay.
        return self if found is self._wrapped else found

    def scalar_rows(self, states: int) -> BarrierValueCache:  # noqa: D102
        known = self._by_size.get(states)
        if known is None:
            known = self._by_size[states] = BarrierValueCache(self._wrapped.scalar_rows(states))
        return known


def _read_only_array(state: Sequence[float]) -> FloatArray:
    """An array that user functions may read but not write: the next part reads it too."""
    array = np.array(state)
    array.setflags(write=False)
    return array


def _of_part(what: str, part: AbstractBarrier, value: Any, *columns: int) -> FloatArray:
    """Checks that a part returned one row for each of its names: otherwise the rows of later parts would be shifted."""
    array, wanted = checked_output(what, value), (len(part.names), *columns)
    if array.shape != wanted:
        raise InputError(f"{what} of barrier {', '.join(part.names)}: got shape {array.shape}, wanted {wanted}")
    return array


def _checked_list(what: str, array: FloatArray, shape: tuple[int, ...]) -> Any:
    # tolist() of a wrong shape would be a list that fails somewhere else, or not at all.
    if array.shape != shape:
        raise InputError(f"{what}: got shape {array.shape}, wanted {shape}")
    return array.tolist()
