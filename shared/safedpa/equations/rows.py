"""Equations of many alike things, such as obstacles, recorded on one tape and sorted by what they depend on.

A group is one equation that yields some numbers for each of its items; a row is one of these numbers. What depends on
the shared numbers alone is computed once for a scene, what depends on the state besides once for a state, and the rest
once for an item. Slopes go the short way in each of them: within an item from the result to what is computed for the
state (few results, many operands), and from there over what was computed for the state from its entries on.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, final

from safedpa.equations.given import Given
from safedpa.equations.slopes import Style, handed_on, negative, product, sum_of
from safedpa.equations.tape import Line, Recorded, Tape, name_of
from safedpa.operations import Operations, Scalar

__all__ = ["Equation", "Level", "RowGroup", "RowTape", "nested"]

Level = Literal["scene", "state", "item"]

_NAME = re.compile(r"\b[a-z]\w*\b")
_DEEPEST = 40
"""Brackets in one expression: Python's own parser takes no more than 200 within each other."""


Equation = Callable[[Given, Operations], Sequence[Scalar]]


@final
@dataclass(frozen=True)
class RowGroup:
    """One equation for items of ``each`` numbers with ``shared`` numbers in common.

    ``steepest`` is what no slope of its rows exceeds, by entry of the state, if that is known; ``body`` the place of
    the first group whose shared numbers are the same: they count once.
    """

    equation: Equation
    shared: int
    each: int
    form: tuple[int, ...] = ()
    steepest: Equation | None = None
    body: int = -1


@final
class RowTape:
    """What the equations of all groups do with a state of so many entries.

    Raises NotStraightError, or what else an equation raises, where they cannot be recorded.
    """

    def __init__(self, states: int, groups: Sequence[RowGroup]) -> None:
        self.groups = tuple(groups)
        self._tape = Tape()
        self.state = [f"s{index}" for index in range(states)]
        self.shared = [self._shared(number, group) for number, group in enumerate(self.groups)]
        """By group, the names of its shared numbers."""
        self.each = [[f"e{number}_{index}" for index in range(group.each)] for number, group in enumerate(self.groups)]
        self.results = [self._run(number, group.equation) for number, group in enumerate(self.groups)]
        """By group, the names of its rows of one item."""
        self.steepest = self._bound()
        """(states,) what no slope of any row exceeds, by name; None: not known."""
        needed = [name for names in self.results for name in names]
        self._tape.keep([*needed, *(self.steepest or ())])
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
            if group.steepest is None:
                return None
            given = Given(self._numbers(self.state), self._numbers(self.shared[number]), (), group.form)
            found = list(group.steepest(given, operations))
            bound = (
                [_larger(one, other, operations) for one, other in zip(bound, found, strict=True)] if bound else found
            )
        return [name_of(entry) for entry in bound]

    def _sort(self) -> None:
        order: list[Level] = ["scene", "state", "item"]
        for name, _, operands in self.lines:
            levels = [self._levels[operand] for operand in operands if operand in self._levels]
            self._levels[name] = max(levels, key=order.index, default="scene")
            if any(operand in self._moves for operand in operands):
                self._moves.add(name)

    def level(self, name: str) -> Level:
        """On what a number depends at most; a constant is the scene's."""
        return self._levels.get(name, "scene")

    def of(self, level: Level, wanted: Sequence[str]) -> list[Line]:
        """The lines of one level that the wanted names need, in order."""
        needed, retained = set(wanted), list[Line]()
        for line in reversed(self.lines):
            if line[0] in needed:
                needed.update(line[2])
                if self._levels[line[0]] == level:
                    retained.append(line)
        return retained[::-1]

    def item_slopes(self, result: str, style: Style) -> tuple[list[tuple[str, str]], dict[str, str]]:
        """Lines (name, term) that compute d(result)/d(v) for each v of the state's level, and their terms by v."""
        terms: dict[str, list[str]] = {result: ["1.0"]}
        lines: list[tuple[str, str]] = []
        for name, form, operands in reversed(self.of("item", [result])):
            if name not in terms or name not in self._moves:
                continue
            slope = self._named(f"d_{name}", sum_of(terms.pop(name)), lines)
            if slope == "0.0":
                continue
            for operand, term in zip(operands, handed_on(form, slope, name, operands, style), strict=True):
                if operand in self._moves and term != "0.0":
                    terms.setdefault(operand, []).append(self._alongside(term, operand))
        return lines, {name: self._named(f"d_{name}", sum_of(found), lines) for name, found in terms.items()}

    def state_slopes(self, wanted: Sequence[str], style: Style) -> tuple[list[tuple[str, str]], dict[str, list[str]]]:
        """Lines that compute d(v)/d(state) for each wanted v of the state's level, and their (states,) terms by v."""
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
                        terms.append(self._alongside(handed_on(form, slope, name, operands, style)[place], operand))
                entries.append(self._named(f"{name}_{index}", sum_of(terms), lines))
            known[name] = entries
        return lines, known

    def chained(self, over: Mapping[str, str], known: Mapping[str, Sequence[str]], index: int) -> str:
        """d(result)/d(entry of the state) from the slopes over what is computed for the state."""
        return sum_of([product(slope, known[name][index]) for name, slope in over.items() if name in known])

    def _alongside(self, term: str, angle: str) -> str:
        """The same with the sine or cosine of an angle where it is computed already."""
        for form in ("sin", "cos"):
            known = next((name for name, other, operands in self.lines if (other, operands) == (form, (angle,))), None)
            term = term if known is None else term.replace(f"{form}({angle})", known)
        return term

    @staticmethod
    def _named(name: str, term: str, lines: list[tuple[str, str]]) -> str:
        """The term itself where it is a number or a name, else a variable that holds it."""
        if re.fullmatch(r"-?[\w.]+", term):
            return term
        if term.startswith("-") and re.fullmatch(r"-\w+", term):
            return negative(term)
        lines.append((name, term))
        return name


def _larger(one: Scalar, other: Scalar, operations: Operations) -> Scalar:
    """The larger of two sizes, which is told at once where one is 0 or both are the same."""
    names = name_of(one), name_of(other)
    if names[0] == names[1] or names[1] == "(0.0)":
        return one
    return other if names[0] == "(0.0)" else operations.maximum(one, other)


def nested(lines: Sequence[tuple[str, str]], wanted: Sequence[str]) -> list[str]:
    """Lines as text, without those that nothing needs; what one other line alone needs stands within that one.

    ``wanted`` are the names and terms that are needed after them.
    """
    after = Counter(word for term in wanted for word in _NAME.findall(term))
    retained: list[tuple[str, str]] = []
    alive = set(after)
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
        if uses[name] == 1 and not after[name] and whole.count("(") < _DEEPEST:
            terms[name] = f"({whole})"
        else:
            found.append(f"{name} = {whole}")
    return found
