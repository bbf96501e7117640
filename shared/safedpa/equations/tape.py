"""What equations do, written down: one line for each operation, by running them once with numbers not yet known.

Equations that ask for the value of a number while they run, to branch on it, cannot be written down.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from typing import Any, final

from safedpa.operations import Operations

__all__ = ["FLOAT_FORMS", "FUNCTIONS", "Line", "NotStraightError", "Recorded", "Tape", "name_of"]

Line = tuple[str, str, tuple[str, ...]]
"""(name, form, operands) of one operation; the form has a place for each operand, or is a function's name."""

FLOAT_FORMS = {
    "absolute": "abs({0})",
    "sign": "float(({0} > 0) - ({0} < 0))",
    "minimum": "({1} if {1} < {0} else {0})",
    "maximum": "({1} if {1} > {0} else {0})",
    "clip": "({1} if {0} < {1} else {2} if {0} > {2} else {0})",
    "where": "({1} if {0} else {2})",
}
"""What the table of floats does, without a call; the other functions are called under their names."""

FUNCTIONS = tuple(field.name for field in fields(Operations))


class NotStraightError(TypeError):
    """The equations ask for the value of a number while they are recorded."""


@final
class Tape:
    """What was done so far: one line for each operation, the same operation on the same numbers only once."""

    def __init__(self) -> None:
        self.lines: list[Line] = []
        self.calls: dict[str, Callable[..., Any]] = {}
        """Functions that are no arithmetic, such as networks, by the name that they are called under."""
        self._known: dict[tuple[str, tuple[str, ...]], Recorded] = {}

    def record(self, form: str, *operands: Any) -> Recorded:
        """The result of one operation."""
        names = tuple(name_of(operand) for operand in operands)
        if (form, names) not in self._known:
            name = f"n{len(self.lines)}"
            self.lines.append((name, form, names))
            self._known[form, names] = Recorded(self, name)
        return self._known[form, names]

    def call(self, function: Callable[..., Any], operands: Sequence[Any], count: int) -> list[Recorded]:
        """The ``count`` results of a function of all ``operands``, called as it is."""
        name = f"call{len(self.calls)}"
        self.calls[name] = function
        results = self.record(f"{name}({', '.join(f'{{{index}}}' for index in range(len(operands)))})", *operands)
        return [self.record(f"{{0}}[{index}]", results) for index in range(count)]

    def keep(self, results: Iterable[str]) -> None:
        """Forgets the lines that no result needs: where x goes within a period, say, if nothing depends on x."""
        needed, retained = set(results), []
        for line in reversed(self.lines):
            if line[0] in needed:
                needed.update(line[2])
                retained.append(line)
        self.lines = retained[::-1]

    def operations(self) -> Operations:
        """A table whose functions write themselves down."""
        table = {name: lambda *operands, name=name: self.record(name, *operands) for name in FUNCTIONS}
        return Operations(**table)


@final
class Recorded:
    """A number that is not known yet, by the name of the variable that will hold it."""

    def __init__(self, tape: Tape, name: str) -> None:
        self.tape, self.name = tape, name

    def __bool__(self) -> bool:
        raise NotStraightError("the equations branch on a number")

    def __float__(self) -> float:
        raise NotStraightError("the equations turn a number into a float")

    __int__ = __index__ = __float__
    __hash__ = None  # type: ignore[assignment]

    def __neg__(self) -> Recorded:
        return self.tape.record("-{0}", self)

    def __pos__(self) -> Recorded:
        return self.tape.record("+{0}", self)

    def __abs__(self) -> Recorded:
        return self.tape.record("abs({0})", self)


def _binary(form: str, *, swapped: bool = False, neutral: float | None = None) -> Callable[[Recorded, Any], Recorded]:
    """With ``neutral`` next to it a number is that number again to the last bit, and nothing is written down."""

    def operation(self: Recorded, other: Any) -> Recorded:
        if neutral is not None and isinstance(other, float) and other == neutral:
            return self
        first, second = (other, self) if swapped else (self, other)
        return self.tape.record(form, first, second)

    return operation


# Of sums none is neutral: 0 makes 0 of -0.
for _name, _sign in {"add": "+", "sub": "-", "mul": "*", "truediv": "/", "pow": "**"}.items():
    _form, _one = f"{{0}} {_sign} {{1}}", 1.0 if _sign in "*/" else None
    setattr(Recorded, f"__{_name}__", _binary(_form, neutral=_one))
    setattr(Recorded, f"__r{_name}__", _binary(_form, swapped=True, neutral=_one if _sign == "*" else None))
for _name, _sign in {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}.items():
    setattr(Recorded, f"__{_name}__", _binary(f"{{0}} {_sign} {{1}}"))


def name_of(operand: Any) -> str:
    """The variable's name, or the constant exactly as it is."""
    if isinstance(operand, Recorded):
        return operand.name
    if isinstance(operand, bool) or not isinstance(operand, (float, int)):
        raise NotStraightError(f"got a {type(operand).__name__} among numbers")
    return f"({operand!r})" if isinstance(operand, int) else f"({float(operand)!r})"
