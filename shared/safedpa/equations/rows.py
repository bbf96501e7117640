"""Records equations of many items, such as obstacles, on one tape, and sorts the operations by what they depend on.

A group is one equation with one or more results for each of its items; a row is one result of one item. Operations on
shared values alone belong to the level "scene" and run once for a scene, those on the state to the level "state", and
all others to the level "item". Differentiation uses the cheaper mode on each level: reverse mode within an item (few
results, many operands), forward mode over the state's entries on the level of the state.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, final

from safedpa.equations.slopes import Style, negative, operand_slopes, product, sum_of
from safedpa.equations.tape import Line, Recorded, Tape, name_of
from safedpa.operations import Operations, Scalar

Level = Literal["scene", "state", "item"]

_NAME = re.compile(r"\b[a-z]\w*\b")
_MAX_NESTING = 40
"""Parentheses within each other in one expression: Python's parser accepts no more than 200."""


class Given(NamedTuple):
    """The arguments of an equation of rows: floats, arrays, or numbers that are being recorded."""

    state: Sequence[Scalar]
    """(states,)"""
    shared: Sequence[Scalar]
    """Values that all items have in common, such as the lengths of the robot's body."""
    each: Sequence[Scalar]
    """Values of one item, such as an obstacle's position and radius."""
    form: tuple[int, ...] = ()
    """Integers that determine the equation itself, such as the index of an entry of the state."""


Equation = Callable[[Given, Operations], Sequence[Scalar]]


@final
@dataclass(frozen=True)
class RowGroup:
    """One equation for items of ``each`` values, with ``shared`` values in common.

    ``grad_bound`` bounds the slopes of its rows, by entry of the state, if a bound is known. ``body`` is the index of
    the first group with the same shared values, which are then stored once; -1: none.
    """

    equation: Equation
    shared: int
    each: int
    form: tuple[int, ...] = ()
    grad_bound: Equation | None = None
    body: int = -1


@final
class RowTape:
    """The recording of all groups' equations for a state of ``states`` entries.

    Raises NotRecordableError, or any exception of an equation, if they cannot be recorded.
    """

    def __init__(self, states: int, groups: Sequence[RowGroup]) -> None:
        self.groups = tuple(groups)
        self._tape = Tape()
        self.state = [f"s{index}" for index in range(states)]
        self.shared = [self._shared(number, group) for number, group in enumerate(self.groups)]
        """By group, the names of its shared values."""
        self.each = [[f"e{number}_{index}" for index in range(group.each)] for number, group in enumerate(self.groups)]
        self.results = [self._run(number, group.equation) for number, group in enumerate(self.groups)]
        """By group, the names of the results of one item."""
        self.grad_bound = self._bound()
        """(states,) names of the bounds of all rows' slopes; None: not known."""
        needed = [name for names in self.results for name in names]
        self._tape.keep([*needed, *(self.grad_bound or ())])
        self.lines = self._tape.lines
        self._levels: dict[str, Level] = {}
        self._moves = set(self.state)
        for name in [name for names in self.shared for name in names]:
            self._levels[name] = "scene"
        self._levels.update(dict.fromkeys(self.state, "state"))
        for name in [name for names in self.each for name in names]:
            self._levels[name] = "item"
        self._sort()

    def _shared(self, number: int, group: RowGroup) -> list[str]:
        owner = number if group.body < 0 else group.body
        return [f"p{owner}_{index}" for index in range(group.shared)]

    def _run(self, number: int, equation: Equation) -> list[str]:
        state, shared, each = map(self._numbers, (self.state, self.shared[number], self.each[number]))
        given = Given(state, shared, each, self.groups[number].form)
        return [name_of(result) for result in equation(given, self._tape.operations())]

    def _numbers(self, names: Sequence[str]) -> list[Recorded]:
        return [Recorded(self._tape, name) for name in names]

    def _bound(self) -> list[str] | None:
        operations, bound = self._tape.operations(), list[Any]()
        for number, group in enumerate(self.groups):
            if group.grad_bound is None:
                return None
            given = Given(self._numbers(self.state), self._numbers(self.shared[number]), (), group.form)
            found = list(group.grad_bound(given, operations))
            bound = (
                [_larger(one, other, operations) for one, other in zip(bound, found, strict=True)] if bound else found
            )
        return [name_of(entry) for entry in bound]

    def _sort(self) -> None:
        order: list[Level] = ["scene", "state", "item"]
        for name, _, operands in self.lines:
            levels = [self._levels[operand] for operand in operands if operand in self._levels]
            self._levels[name] = max(levels, key=order.index, default="scene")
            # what does not move with the state has no slope over it
            if any(operand in self._moves for operand in operands):
                self._moves.add(name)

    def level(self, name: str) -> Level:
        """Returns the level of a value; that of a constant is the scene."""
        return self._levels.get(name, "scene")

    def of(self, level: Level, wanted: Sequence[str]) -> list[Line]:
        """Returns the lines of one level on which the wanted values depend, in order."""
        needed, retained = set(wanted), list[Line]()
        for line in reversed(self.lines):
            if line[0] in needed:
                needed.update(line[2])
                if self._levels[line[0]] == level:
                    retained.append(line)
        return retained[::-1]

    def item_slopes(self, result: str, style: Style) -> tuple[list[tuple[str, str]], dict[str, str]]:
        """Returns lines (name, term) for d(result)/d(v), v the values of the state's level, and their terms by v."""
        terms: dict[str, list[str]] = {result: ["1.0"]}
        lines: list[tuple[str, str]] = []
        for name, form, operands in reversed(self.of("item", [result])):
            if name not in terms or name not in self._moves:
                continue
            # all uses of a value come after it on the tape, so in reverse order its sum of terms is complete here
            slope = self._named(f"d_{name}", sum_of(terms.pop(name)), lines)
            if slope == "0.0":
                continue
            for operand, term in zip(operands, operand_slopes(form, slope, name, operands, style), strict=True):
                if operand in self._moves and term != "0.0":
                    terms.setdefault(operand, []).append(self._alongside(term, operand))
        return lines, {name: self._named(f"d_{name}", sum_of(found), lines) for name, found in terms.items()}

    def state_slopes(self, wanted: Sequence[str], style: Style) -> tuple[list[tuple[str, str]], dict[str, list[str]]]:
        """Returns lines for d(v)/d(state), v the wanted values of the state's level, and their (states,) terms by v."""
        known = {name: ["1.0" if name == other else "0.0" for other in self.state] for name in self.state}
        lines: list[tuple[str, str]] = []
        for name, form, operands in self.of("state", wanted):
            if name not in self._moves:
                continue
            entries = []
            for index in range(len(self.state)):
                terms = []
                for place, operand in enumerate(operands):
                    slope = known.get(operand, ["0.0"] * len(self.state))[index]
                    if slope != "0.0":
                        terms.append(
                            self._alongside(operand_slopes(form, slope, name, operands, style)[place], operand)
                        )
                entries.append(self._named(f"{name}_{index}", sum_of(terms), lines))
            known[name] = entries
        return lines, known

    def chained(self, over: Mapping[str, str], known: Mapping[str, Sequence[str]], index: int) -> str:
        """Returns d(result)/d(entry of the state), from the slopes over the values of the state's level."""
        return sum_of([product(slope, known[name][index]) for name, slope in over.items() if name in known])

    def _alongside(self, term: str, angle: str) -> str:
        """Returns the term with the variable of a sine or cosine that is recorded already."""
        for form in ("sin", "cos"):
            known = next((name for name, other, operands in self.lines if (other, operands) == (form, (angle,))), None)
            term = term if known is None else term.replace(f"{form}({angle})", known)
        return term

    @staticmethod
    def _named(name: str, term: str, lines: list[tuple[str, str]]) -> str:
        """Returns the term itself if it is a number or a name, else a variable for which it adds a line."""
        if re.fullmatch(r"-?[\w.]+", term):
            return term
        if term.startswith("-") and re.fullmatch(r"-\w+", term):
            return negative(term)
        lines.append((name, term))
        return name


def _larger(one: Scalar, other: Scalar, operations: Operations) -> Scalar:
    """Returns the larger of two sizes."""
    # without an operation where both are the same or one is the constant 0
    names = name_of(one), name_of(other)
    if names[0] == names[1] or names[1] == "(0.0)":
        return one
    return other if names[0] == "(0.0)" else operations.maximum(one, other)


def nested(lines: Sequence[tuple[str, str]], wanted: Sequence[str]) -> list[str]:
    """Returns lines as source, without unused ones; a value that is used once is written into the line that uses it.

    ``wanted`` are the names and terms that are used after them.
    """
    after = Counter(word for term in wanted for word in _NAME.findall(term))
    retained: list[tuple[str, str]] = []
    alive = set(after)  # backwards: a line is used if a later one that is used reads it
    for name, term in reversed(lines):
        if name in alive:
            retained.append((name, term))
            alive.update(_NAME.findall(term))
    retained.reverse()
    uses = Counter(word for _, term in retained for word in _NAME.findall(term))
    terms: dict[str, str] = {}
    found = []
    for name, term in retained:
        whole = _NAME.sub(lambda match: terms.pop(match[0], match[0]), term)
        if uses[name] == 1 and not after[name] and whole.count("(") < _MAX_NESTING:
            terms[name] = f"({whole})"
        else:
            found.append(f"{name} = {whole}")
    return found
