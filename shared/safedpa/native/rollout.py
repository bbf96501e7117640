"""A kernel for a model under its backup: the path, the minimum of h along it, and its derivatives, each in one C call.

The generated functions step, backup and h are followed by ``path_minimum.c``. What may differ between barriers of one
kind, constants and items alike, is data of the call, so it needs no other kernel.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from threading import local
from typing import Any, Final, Self, final

import numpy as np
from numpy.typing import NDArray

from safedpa.equations.tape import Line, NotRecordableError
from safedpa.native.c_source import PRELUDE, Constants, c_lines, function_source, slope_lines
from safedpa.native.library import load, load_module
from safedpa.native.tracing import RecordedFunction

__all__ = ["FoundMinimum", "RecordedItems", "RolloutKernel"]

Floats = NDArray[np.float64]


_SETUP: Final = """
#define EXPORTED __attribute__((visibility("default")))
typedef struct {
    const double *k_step, *k_backup, *k_h, *latent, *held, *shared, *each;
    double time;
    int items, rows, ticks;
} setup;
"""


class _Setup(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("k_step", "k_backup", "k_h", "latent", "held", "shared", "each")),
        ("time", ctypes.c_double),
        *((name, ctypes.c_int) for name in ("items", "rows", "ticks")),
    ]


def _none() -> Floats:
    return np.empty(0)


_INPUTS: Final = ("origin", "x", "directions")
_OUTPUTS: Final = ("path", "memory", "values", "shares", "size", "out", "flags", "points")


class _Call(ctypes.Structure):
    _fields_ = [("u", _Setup), *((name, ctypes.c_void_p) for name in (*_INPUTS, *_OUTPUTS))]


@final
@dataclass(frozen=True)
class RecordedItems:
    """h of one item as recorded lines: from the names of state, shared and item's values to ``results``.

    ``squares``: hypot as the root of a sum of squares, as compiled barriers compute it.
    """

    state: tuple[str, ...]
    shared: tuple[str, ...]
    each: tuple[str, ...]
    lines: tuple[Line, ...]
    results: tuple[str, ...]
    squares: bool


@final
@dataclass(frozen=True)
class FoundMinimum:
    """The minimum (m,) of each h, its points as chord and share (m,), and the size (m,) of each h."""

    values: Floats
    chords: NDArray[np.int32]
    shares: Floats
    size: Floats


@final
class _Workspace:
    """The arrays of one thread: a call writes into them, and copies what it returns."""

    def __init__(self, kernel: RolloutKernel) -> None:
        states, m, horizon = kernel.states, kernel.count, kernel.horizon
        # kept alive by the workspace: the structure has their addresses only
        self._data = (*kernel.constants, kernel.latent, kernel.held, kernel.shared, kernel.each)
        setup = _Setup(*(array.ctypes.data for array in self._data), 0.0, len(kernel.each), m, horizon)
        size = kernel.functions.memory_size(ctypes.byref(setup))
        self.origin, self.x, self.directions = np.empty(states), np.empty(states), np.empty((kernel.actions, states))
        self.path, self.memory, self.found = np.empty((horizon + 2, states)), np.empty(size), np.empty((3, m))
        self.out, self.flags = np.empty(m * max(states, kernel.actions)), np.empty(m, dtype=np.int32)
        self.points = np.empty(m, dtype=np.int32)
        arrays = (
            self.origin, self.x, self.directions, self.path, self.memory, *self.found, self.out, self.flags, self.points
        )  # fmt: skip
        self.call = _Call(setup, *(array.ctypes.data for array in arrays))
        self.arrays = (*self._data, *arrays)
        self.for_search: dict[bool, Any] = {}
        self.reference = ctypes.byref(self.call)

    def begin(self, origin: Floats | None, state: Floats, time: float) -> int:
        """Copies the inputs, and returns whether there is an origin."""
        self.call.u.time = time
        self.x[:] = state
        if origin is None:
            return 0
        self.origin[:] = origin
        return 1

    def set_points(self, at: FoundMinimum) -> None:
        """Copies the points of a minimum."""
        self.points[:], self.found[1] = at.chords, at.shares


@final
@dataclass(frozen=True, eq=False)
class RolloutKernel:
    """The compiled functions of one kind of rollout, with the data of one barrier.

    ``step`` has the inputs state, action, latent and time, ``backup`` the state; a constant backup is ``held``
    (actions,) instead. Threads may share an instance: each has arrays of its own.
    """

    functions: ctypes.PyDLL
    states: int
    actions: int
    has_gradient: bool
    constants: tuple[Floats, Floats, Floats]
    rows: int
    """Rows of h for one item."""
    horizon: int = 1
    latent: Floats = field(default_factory=_none)
    held: Floats = field(default_factory=_none)
    shared: Floats = field(default_factory=_none)
    each: Floats = field(default_factory=_none)
    """(items, values)"""
    spaces: local = field(default_factory=local)

    @classmethod
    def compiled(cls, step: RecordedFunction, backup: RecordedFunction | None, h: RecordedItems) -> Self:
        """The kernel without data. Raises NotRecordableError for an operation without C, NoKernelError as ``load``."""
        source, has_gradient, constants = _source(step, backup, h)
        states, actions = len(step.inputs[0]), len(step.inputs[1])
        return cls(_typed(load(source)), states, actions, has_gradient, constants, len(h.results))

    def with_data(
        self, horizon: int, latent: Floats, held: Floats, shared: Sequence[float], each: Sequence[Sequence[float]]
    ) -> Self:
        """Returns the kernel for one barrier; an h without items has one empty item."""
        items = np.array(each, dtype=np.float64).reshape(len(each), -1)
        numbers = np.array(shared, dtype=np.float64)
        return replace(self, horizon=horizon, latent=latent, held=held, shared=numbers, each=items, spaces=local())

    @property
    def count(self) -> int:
        """All rows of h."""
        return self.rows * len(self.each)

    def minimum(self, origin: Floats | None, state: Floats, time: float) -> FoundMinimum | None:
        """H at ``state`` (states,); the path begins with ``origin`` if given. None if a state is not finite."""
        work = self._workspace()
        if self.functions.call_rollout(work.reference, work.begin(origin, state, time)) < 0:
            return None
        found = work.found.copy()
        return FoundMinimum(found[0], work.points.copy(), found[1], found[2])

    def path(self, origin: Floats | None, state: Floats, time: float) -> Floats | None:
        """The states (k, states) from ``origin``, if given, and ``state`` on; None if one is not finite."""
        work = self._workspace()
        count = self.functions.call_rollout(work.reference, work.begin(origin, state, time))
        return None if count < 0 else work.path[:count].copy()

    def h_near(self, at: FoundMinimum, origin: Floats | None, state: Floats, time: float) -> Floats | None:
        """h_i (m,) at the same points of the path from another state. None if a state is not finite."""
        work = self._workspace()
        work.set_points(at)
        failed = self.functions.call_h_near(work.reference, work.begin(origin, state, time))
        return None if failed else work.out[: self.count].copy()

    def lie_differences(
        self, at: FoundMinimum, origin: Floats | None, state: Floats, directions: Floats, time: float
    ) -> Floats | None:
        """d(H)/d(u) (m, n) at ``state`` + ``directions`` (states, n) u, by central differences; None as ``h_near``.

        Also None for more directions than the model has actions.
        """
        columns = directions.shape[1]
        if columns > self.actions:
            return None
        work = self._workspace()
        work.set_points(at)
        work.directions[:columns] = directions.T
        failed = self.functions.call_lie_differences(work.reference, work.begin(origin, state, time), columns)
        return None if failed else work.out[: self.count * columns].reshape(self.count, columns).copy()

    def gradient(self, at: FoundMinimum, origin: Floats | None, state: Floats, time: float) -> Floats | None:
        """d(H)/d(x) (m, states) at ``state`` by the chain rule.

        None if a derivative is not known, if the backup is a function, or if a state is not finite.
        """
        if not self.has_gradient:
            return None
        work = self._workspace()
        has_origin = work.begin(origin, state, time)
        count = self.functions.call_rollout(work.reference, has_origin)
        if count < 0:
            return None
        work.set_points(at)
        self.functions.call_gradient(work.reference, has_origin, count)
        return work.out[: self.count * self.states].reshape(self.count, self.states).copy()

    def rows_for_search(self, exact: bool) -> Any:
        """``safedpa_kernel.Rollout`` over the arrays of this thread; ``exact``: slopes by the chain rule."""
        work = self._workspace()
        if exact not in work.for_search:
            names = "call_rollout", "call_lie_differences", "call_gradient"
            run, differences, gradient = [_address(self.functions, name) for name in names]
            own = run, differences, gradient if exact else 0, ctypes.addressof(work.call)
            kept = self.functions, work.call, work.arrays
            work.for_search[exact] = load_module().Rollout(*own, self.count, self.states, kept)
        return work.for_search[exact]

    def _workspace(self) -> _Workspace:
        try:
            work: _Workspace = self.spaces.work
        except AttributeError:
            work = self.spaces.work = _Workspace(self)
        return work


def _address(functions: ctypes.PyDLL, name: str) -> int:
    found = ctypes.cast(getattr(functions, name), ctypes.c_void_p).value
    assert found is not None
    return found


def _typed(functions: ctypes.PyDLL) -> ctypes.PyDLL:
    pointer, number = ctypes.c_void_p, ctypes.c_int
    functions.memory_size.argtypes = [pointer]
    functions.call_rollout.argtypes = functions.call_h_near.argtypes = [pointer, number]
    functions.call_lie_differences.argtypes = functions.call_gradient.argtypes = [pointer, number, number]
    return functions


@cache
def _template() -> str:
    return Path(__file__).with_name("path_minimum.c").read_text(encoding="utf-8")


def _source(
    step: RecordedFunction, backup: RecordedFunction | None, h: RecordedItems
) -> tuple[str, bool, tuple[Floats, Floats, Floats]]:
    """Returns the C source, whether it has derivatives, and the constants of step, backup and h."""
    k = tuple(Constants() for _ in range(3))
    actions = len(step.inputs[1])
    text = [function_source("step_equations", step, k[0], ("s", "a", "z", "t"))]
    text.append(
        "static void step(const setup *u, const double *x, const double *a, double *next)\n"
        "{\n    step_equations(x, a, u->latent, &u->time, u->k_step, next);\n}\n"
    )
    if backup is None:
        held = "".join(f" a[{index}] = u->held[{index}];" for index in range(actions))
        text.append(f"static void backup(const setup *u, const double *x, double *a)\n{{\n   {held}\n}}\n")
    else:
        text.append(function_source("backup_equations", backup, k[1], ("s",)))
        text.append(
            "static void backup(const setup *u, const double *x, double *a)\n"
            "{\n    backup_equations(x, u->k_backup, a);\n}\n"
        )
    text.append(_h_source(h, k[2]))
    slopes = _slope_source(step, h, k) if backup is None else None
    sizes = f"#define STATES {len(step.inputs[0])}\n#define ACTIONS {actions}\n"
    derivatives = "" if slopes is None else "#define DERIVATIVES\n" + slopes
    whole = "\n".join((PRELUDE, sizes, _SETUP, *text, derivatives, _template()))
    return whole, slopes is not None, tuple(np.array(one.values) for one in k)  # type: ignore[return-value]


def _item_head(h: RecordedItems) -> list[str]:
    entries = [f"const double {name} = s[{index}];" for index, name in enumerate(h.state)]
    entries += [f"const double {name} = u->shared[{index}];" for index, name in enumerate(h.shared)]
    return ["const double *k = u->k_h;", *entries]


def _item_lines(h: RecordedItems, k: Constants) -> list[str]:
    item = [f"const double {name} = e[{index}];" for index, name in enumerate(h.each)]
    return [*item, *(f"const double {n} = {term};" for n, term in c_lines(h.lines, k, squares=h.squares))]


def _h_source(h: RecordedItems, k: Constants) -> str:
    lines = _item_lines(h, k)
    lines += [f"out[item * {len(h.results)} + {i}] = {k.operand(result)};" for i, result in enumerate(h.results)]
    loop = "\n        ".join([f"const double *e = u->each + item * {len(h.each)};", "(void)e;", *lines])
    head = "\n    ".join([*_item_head(h), "(void)k;"])
    return (
        "static void h(const setup *u, const double *s, double *out)\n{\n"
        f"    {head}\n    for (int item = 0; item < u->items; item++) {{\n        {loop}\n    }}\n}}\n"
    )


def _slope_source(step: RecordedFunction, h: RecordedItems, k: Sequence[Constants]) -> str | None:
    """Returns step_slopes (states, states) and h_slopes (states,) of one row; None if a derivative is not known."""
    try:
        body = _slopes_of(step.lines, k[0], step.inputs[0], step.results)
        of_row = _slopes_of(h.lines, k[2], h.state, h.results)
    except NotRecordableError:
        return None
    count = len(step.inputs[0])
    values = function_source("step_values", replace(step, results=()), k[0], ("s", "a", "z", "t"), lambda *_: body)
    own = "\n    ".join(
        [*_item_head(h), f"const double *e = u->each + row / {len(h.results)} * {len(h.each)};", "(void)e; (void)k;"]
    )
    table = "\n    ".join([f"double out[{max(len(h.results) * count, 1)}];", *_item_lines(h, k[2]), *of_row])
    chosen = f"memcpy(slope, out + row % {len(h.results)} * {count}, {count} * sizeof(double));"
    return (
        f"{values}\n"
        "static void step_slopes(const setup *u, const double *x, double *out)\n{\n"
        "    double a[ACTIONS + 1];\n    backup(u, x, a);\n"
        "    step_values(x, a, u->latent, &u->time, u->k_step, out);\n}\n\n"
        "static void h_slopes(const setup *u, const double *s, int row, double *slope)\n"
        f"{{\n    {own}\n    {table}\n    {chosen}\n}}\n"
    )


def _slopes_of(lines: Sequence[Line], k: Constants, state: Sequence[str], results: Sequence[str]) -> list[str]:
    slopes, table = slope_lines(lines, k, state, results)
    found = [f"const double {name} = {term};" for name, term in slopes]
    entries = [entry for row in table for entry in row]
    return [*found, *(f"out[{index}] = {entry};" for index, entry in enumerate(entries))]
