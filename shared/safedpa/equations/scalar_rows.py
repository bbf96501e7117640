"""Generates recorded rows as a class over Python floats, for one robot.

Floats because the first NumPy call in a tick takes several microseconds. ``safedpa.native`` translates the same lines
to C; the class answers where there is no compiler, and for numbers that Python's math refuses.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import Any

from safedpa.equations.chain_rule import chain_rule
from safedpa.equations.rows import Level, RowTape, nested
from safedpa.equations.slopes import plain_choice
from safedpa.equations.tape import FLOAT_FORMS, FUNCTIONS, Line
from safedpa.operations import FLOATS

SMALL_AND_LARGE = ("1e-290", "1e+290")
"""Between these, the root of a sum of squares is as exact as ``hypot``; beyond, the squares underflow or overflow."""

Lines = list[tuple[str, str]]


def scalar_rows(tape: RowTape) -> Any:
    """Returns the class, compiled now."""
    scope: dict[str, Any] = {"inf": math.inf, "nan": math.nan, "chain_rule": chain_rule, "Sequence": Sequence}
    scope.update({name: getattr(FLOATS, name) for name in FUNCTIONS})
    exec(scalar_class(tape, "Rows"), scope)  # arithmetic on generated names only
    return scope["Rows"]


def scalar_class(tape: RowTape, name: str) -> str:
    """Returns the source of a class whose instances hold the values of one scene."""
    parts = [_beginning(tape), _h_floats(tape), _grad_h_floats(tape), _lie_derivative_floats(), _grad_bound(tape)]
    body = "\n\n".join("\n".join(f"    {line}".rstrip() for line in part) for part in parts)
    return f'class {name}:\n    """h of all rows at a state, and its slopes."""\n\n{body}\n'


def _value(line: Line) -> Lines:
    name, form, operands = line
    if form == "hypot":
        first, second = operands
        small, large = SMALL_AND_LARGE
        root = f"(sqrt({name}_square) if {small} < {name}_square < {large} else hypot({first}, {second}))"
        return [(f"{name}_square", f"{first} * {first} + {second} * {second}"), (name, root)]
    if form in FUNCTIONS:
        written = FLOAT_FORMS.get(form)
        return [(name, f"{form}({', '.join(operands)})" if written is None else written.format(*operands))]
    return [(name, form.format(*operands))]


def values(tape: RowTape, level: Level, wanted: Sequence[str]) -> Lines:
    """Returns the lines (name, term) of one level on which the wanted values depend."""
    return [line for one in tape.of(level, wanted) for line in _value(one)]


def _text(lines: Sequence[str]) -> set[str]:
    return {word for line in lines for word in re.findall(r"\b[a-z]\w*\b", line)}


def shared_names(tape: RowTape) -> list[str]:
    """Returns the names of all shared values, each once."""
    return list(dict.fromkeys(name for names in tape.shared for name in names))


def retained_names(tape: RowTape) -> list[str]:
    """Returns the values that the constructor computes and the methods use: the attributes."""
    every = [name for names in tape.results for name in names] + list(tape.grad_bound or ())
    needed = {operand for level in ("state", "item") for line in tape.of(level, every) for operand in line[2]}
    needed |= set(every)
    names = [*shared_names(tape), *(line[0] for line in tape.of("scene", every))]
    return [name for name in names if name in needed]


def scene_lines(tape: RowTape) -> list[str]:
    """Returns the lines that compute these values from the shared ones."""
    retained = retained_names(tape)
    return nested(values(tape, "scene", retained), retained)


def _beginning(tape: RowTape) -> Iterator[str]:
    yield "def __init__(self, shared: Sequence[Sequence[float]], each: Sequence[Sequence[Sequence[float]]]) -> None:"
    owners = [group.body < 0 for group in tape.groups]
    for number, names in enumerate(tape.shared):
        if owners[number]:
            for index, name in enumerate(names):
                yield f"    {name}: float = shared[{number}][{index}]"
    retained = retained_names(tape)
    for line in scene_lines(tape):
        yield f"    {line}"
    for name in retained:
        yield f"    self._{name}: float = {name}"
    for number, names in enumerate(tape.each):
        kind, entries = ", ".join(["float"] * len(names)), "".join(f"item[{index}], " for index in range(len(names)))
        yield f"    self._items{number}: list[tuple[{kind or '()'}]] = [({entries.strip()}) for item in each[{number}]]"


def _head(tape: RowTape, needed: set[str]) -> Iterator[str]:
    for index, name in enumerate(tape.state):
        if name in needed:
            yield f"    {name}: float = state[{index}]"
    for name in retained_names(tape):
        if name in needed:
            yield f"    {name} = self._{name}"


def _unpacked(tape: RowTape, number: int, lines: Sequence[str]) -> str:
    """Returns the target that unpacks an item; values that no line uses are named ``_``."""
    needed = _text(lines)
    names = [name if name in needed else "_" for name in tape.each[number]]
    return f"({names[0]},)" if len(names) == 1 else ", ".join(names) or "_"


def _h_floats(tape: RowTape) -> Iterator[str]:
    yield "def h_floats(self, state: Sequence[float]) -> list[float]:"
    yield '    """h (rows,) at ``state``."""'
    every = [name for names in tape.results for name in names]
    items = [nested(values(tape, "item", names), names) for names in tape.results]
    wanted = [*every, *(line for lines in items for line in lines)]
    state = nested(values(tape, "state", every), wanted)
    yield from _head(tape, _text([*state, *wanted]))
    yield from (f"    {line}" for line in state)
    yield "    h: list[float] = []"
    for number, lines in enumerate(items):
        yield f"    for {_unpacked(tape, number, [*lines, *tape.results[number]])} in self._items{number}:"
        yield from (f"        {line}" for line in lines)
        names = ", ".join(tape.results[number])
        yield f"        h.append({names})" if len(tape.results[number]) == 1 else f"        h += [{names}]"
    yield "    return h"


def _grad_h_floats(tape: RowTape) -> Iterator[str]:
    kind = f"list[tuple[{', '.join(['float'] * len(tape.state))}]]"
    yield f"def grad_h_floats(self, state: Sequence[float], rows: Sequence[int]) -> {kind}:"
    yield '    """d(h_i)/d(state) of the rows asked for."""'
    groups = [[row_slopes(tape, number, result) for result in names] for number, names in enumerate(tape.results)]
    over = {name for rows in groups for _, slopes, _ in rows for name in slopes}
    known_lines, known = tape.state_slopes(sorted(over), plain_choice)
    bodies = [[_row_text(tape, row, known) for row in rows] for rows in groups]
    wanted = [line for bodies_of in bodies for body in bodies_of for line in body]
    needed = [*over, *(name for name in _text(wanted) if tape.level(name) == "state")]
    state = nested([*values(tape, "state", needed), *known_lines], wanted)
    yield from _head(tape, _text([*state, *wanted]))
    yield from (f"    {line}" for line in state)
    # rows are numbered group by group: which group a row belongs to follows from the ends
    yield "    end0 = 0"
    for number, names in enumerate(tape.results):
        yield f"    end{number + 1} = end{number} + {len(names)} * len(self._items{number})"
    yield f"    found: {kind} = []"
    yield "    for row in rows:"
    for number, rows in enumerate(bodies):
        yield from _group_slopes(tape, number, rows)
    yield "    return found"


Row = tuple[Lines, dict[str, str], str]
"""Lines of one row, its slopes over the values of the state's level, and its name."""


def row_slopes(tape: RowTape, number: int, result: str) -> Row:
    """Returns the row of one result of one group."""
    lines, over = tape.item_slopes(result, plain_choice)
    return [*values(tape, "item", [result]), *lines], over, result


def row_terms(tape: RowTape, row: Row, known: dict[str, list[str]]) -> tuple[list[str], list[str]]:
    """Returns the lines of one row, and the terms of its slopes over the state's entries."""
    lines, over, _ = row
    terms = [tape.chained(over, known, index) for index in range(len(tape.state))]
    return nested(lines, terms), terms


def _row_text(tape: RowTape, row: Row, known: dict[str, list[str]]) -> list[str]:
    lines, terms = row_terms(tape, row, known)
    return [*lines, f"found.append(({', '.join(terms)}))"]


def _group_slopes(tape: RowTape, number: int, rows: Sequence[Sequence[str]]) -> Iterator[str]:
    last = number + 1 == len(tape.groups)
    yield (
        f"        {'if' if number == 0 else 'elif'} row < end{number + 1}:"
        if not last or number == 0
        else "        else:"
    )
    several = len(rows) > 1
    place = f"(row - end{number}) // {len(rows)}" if several else f"row - end{number}"
    target = _unpacked(tape, number, [line for row in rows for line in row])
    if target.strip("(,)_ "):
        yield f"            {target} = self._items{number}[{place}]"
    if not several:
        yield from (f"            {line}" for line in rows[0])
        return
    yield f"            which = (row - end{number}) % {len(rows)}"
    for index, row in enumerate(rows):
        yield (
            f"            {'if' if index == 0 else 'elif'} which == {index}:"
            if index + 1 < len(rows)
            else "            else:"
        )
        yield from (f"                {line}" for line in row)


def _lie_derivative_floats() -> Iterator[str]:
    yield "def lie_derivative_floats("
    yield "    self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]"
    yield ") -> list[list[float]]:"
    yield '    """d(h_i)/d(a_j) of the rows asked for, where the state moves by g (states, actions) a."""'
    yield "    return chain_rule(self.grad_h_floats(state, rows), g)"


def _grad_bound(tape: RowTape) -> Iterator[str]:
    kind = f"tuple[{', '.join(['float'] * len(tape.state))}]"
    if tape.grad_bound is None:
        yield "def grad_bound(self, state: Sequence[float]) -> None:"
        yield '    """What no slope exceeds is not known."""'
        return
    yield f"def grad_bound(self, state: Sequence[float]) -> {kind}:"
    yield '    """Of each entry of the state: no |d(h_i)/d(entry)| is greater at ``state``, whatever the row."""'
    lines = nested(values(tape, "state", tape.grad_bound), tape.grad_bound)
    yield from _head(tape, _text([*lines, *tape.grad_bound]))
    yield from (f"    {line}" for line in lines)
    yield f"    return {', '.join(tape.grad_bound)}"
