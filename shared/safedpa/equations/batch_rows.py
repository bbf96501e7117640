"""Compiles recorded rows to functions of NumPy arrays, for many robots at once."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.equations.rows import RowTape, nested
from safedpa.equations.slopes import array_choice
from safedpa.equations.tape import FUNCTIONS, Line
from safedpa.operations import NUMPY

Columns = Sequence[Any]


@final
class BatchRows:
    """h and slopes of the rows of many robots.

    ``shared`` and ``each`` have, for each group, one array per value: (robots, 1) and (robots, items).
    """

    def __init__(self, tape: RowTape) -> None:
        self._states = len(tape.state)
        self._h = _made(_h_text(tape), "h")
        self._grad_h = _made(_grad_h_text(tape), "grad_h")

    def h(self, state: FloatArray, shared: Sequence[Columns], each: Sequence[Columns]) -> FloatArray:
        """Returns h (robots, rows) at states (robots, states)."""
        # where() computes both branches: the one that is not chosen may divide by 0
        with np.errstate(all="ignore"):
            groups = self._h(self._columns(state), shared, each)
        return np.concatenate([_rows(group, len(state)) for group in groups], axis=1)

    def grad_h(self, state: FloatArray, shared: Sequence[Columns], each: Sequence[Columns]) -> FloatArray:
        """Returns d(h)/d(state) (robots, rows, states) at states (robots, states)."""
        with np.errstate(all="ignore"):
            groups = self._grad_h(self._columns(state), shared, each)
        sizes = [len(rows) * items for rows, items in groups]
        found = np.zeros((len(state), sum(sizes), state.shape[1]))
        first = 0
        for (rows, items), size in zip(groups, sizes, strict=True):
            for place, row in enumerate(rows):
                # rows of a group are interleaved item by item, as in h
                own = found[:, first + place : first + size : len(rows)]
                for index in range(self._states):
                    # a slope that is 0 in every item is written as the float 0.0: found is 0 already
                    if not (isinstance(row[index], float) and row[index] == 0.0) and items:
                        own[..., index] = row[index]
            first += size
        return found

    def _columns(self, state: FloatArray) -> list[FloatArray]:
        return [state[:, index : index + 1] for index in range(self._states)]


def _rows(group: tuple[Sequence[Any], int], robots: int) -> FloatArray:
    """Returns (robots, items * rows of an item), item by item."""
    rows, items = group
    if len(rows) == 1:
        return np.asarray(np.broadcast_to(rows[0], (robots, items)))
    table = np.empty((robots, items, len(rows)))
    for index, row in enumerate(rows):
        table[..., index] = row
    return table.reshape(robots, -1)


def _made(text: str, name: str) -> Callable[..., Any]:
    scope: dict[str, Any] = {"inf": math.inf, "nan": math.nan}
    scope.update({function: getattr(NUMPY, function) for function in FUNCTIONS})
    exec(text, scope)  # arithmetic on generated names only
    made: Callable[..., Any] = scope[name]
    return made


def _value(line: Line) -> tuple[str, str]:
    name, form, operands = line
    return name, f"{form}({', '.join(operands)})" if form in FUNCTIONS else form.format(*operands)


def _head(tape: RowTape) -> list[str]:
    head = [f"[{', '.join(tape.state)}] = state"]
    for number, group in enumerate(tape.groups):
        if group.body < 0 and group.shared:
            head.append(f"[{', '.join(tape.shared[number])}] = shared[{number}]")
        if group.each:
            head.append(f"[{', '.join(tape.each[number])}] = each[{number}]")
    return head


def _items(tape: RowTape, number: int) -> str:
    """Returns the source of the number of items of a group."""
    return f"{tape.each[number][0]}.shape[1]" if tape.each[number] else "1"


def _h_text(tape: RowTape) -> str:
    every = [name for names in tape.results for name in names]
    lines = [_value(line) for level in ("scene", "state", "item") for line in tape.of(level, every)]
    groups = [f"([{', '.join(names)}], {_items(tape, number)})" for number, names in enumerate(tape.results)]
    text = [*_head(tape), *nested(lines, every), f"return [{', '.join(groups)}]"]
    return "\n    ".join(["def h(state, shared, each):", *text])


def _grad_h_text(tape: RowTape) -> str:
    rows = [[tape.item_slopes(result, array_choice) for result in names] for names in tape.results]
    over = sorted({name for group in rows for _, slopes in group for name in slopes})
    known_lines, known = tape.state_slopes(over, array_choice)
    every = [name for names in tape.results for name in names]
    lines = [_value(line) for level in ("scene", "state", "item") for line in tape.of(level, every)]
    lines += known_lines
    groups, wanted = [], list[str]()
    for number, group in enumerate(rows):
        reported = []
        for place, (own, slopes) in enumerate(group):
            lines += [(f"{name}_{number}_{place}", _renamed(term, own, number, place)) for name, term in own]
            terms = [tape.chained(slopes, known, index) for index in range(len(tape.state))]
            reported.append(f"[{', '.join(_renamed(term, own, number, place) for term in terms)}]")
        groups.append(f"([{', '.join(reported)}], {_items(tape, number)})")
        wanted += reported
    text = [*_head(tape), *nested(lines, wanted), f"return [{', '.join(groups)}]"]
    return "\n    ".join(["def grad_h(state, shared, each):", *text])


def _renamed(term: str, own: Sequence[tuple[str, str]], number: int, place: int) -> str:
    """Returns the term with the slopes of one row renamed: other rows have slopes of the same values."""
    names = {name for name, _ in own}
    return re.sub(r"\b[a-z]\w*\b", lambda m: f"{m[0]}_{number}_{place}" if m[0] in names else m[0], term)
