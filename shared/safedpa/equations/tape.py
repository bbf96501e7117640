"""Records equations: they run once with symbolic numbers, and each operation becomes one line of a tape.

Equations that need the value of a number while they run, to branch on it, cannot be recorded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from typing import Any, final

from safedpa.operations import Operations

Line = tuple[str, str, tuple[str, ...]]
"""(name, form, operands) of one operation; the form is a template such as ``{0} + {1}``, or a function's name."""

FLOAT_FORMS = {
    "absolute": "abs({0})",
    "sign": "float(({0} > 0) - ({0} < 0))",
    "minimum": "({1} if {1} < {0} else {0})",
    "maximum": "({1} if {1} > {0} else {0})",
    "clip": "({1} if {0} < {1} else {2} if {0} > {2} else {0})",
    "where": "({1} if {0} else {2})",
}
"""Functions of ``FLOATS`` as expressions, which saves a call; the others are called by their names."""

FUNCTIONS = tuple(field.name for field in fields(Operations))


class NotRecordableError(TypeError):
    """The equations need the value of a number while they are recorded."""


@final
class Tape:
    """The operations so far, one line each; the same operation on the same operands is recorded once."""

    def __init__(self) -> None:
        self.lines: list[Line] = []
        self.calls: dict[str, Callable[..., Any]] = {}
        """Functions that are no arithmetic, such as networks, by the names under which lines call them."""
        self._known: dict[tuple[str, tuple[str, ...]], Recorded] = {}

    def record(self, form: str, *operands: Any) -> Recorded:
        """Records one operation, and returns its result."""
        names = tuple(name_of(operand) for operand in operands)
        # common subexpressions: operations have no side effects, so equal operands give an equal result
        if (form, names) not in self._known:
            name = f"n{len(self.lines)}"
            self.lines.append((name, form, names))
            self._known[form, names] = Recorded(self, name)
        return self._known[form, names]

    def call(self, function: Callable[..., Any], operands: Sequence[Any], count: int) -> list[Recorded]:
        """Records a call of ``function(*operands)``, and returns its ``count`` results."""
        name = f"call{len(self.calls)}"
        self.calls[name] = function
        results = self.record(f"{name}({', '.join(f'{{{index}}}' for index in range(len(operands)))})", *operands)
        return [self.record(f"{{0}}[{index}]", results) for index in range(count)]

    def keep(self, results: Iterable[str]) -> None:
        """Removes the lines on which no result depends, such as a position in the stages of an integrator."""
        needed, retained = set(results), []
        for line in reversed(self.lines):
            if line[0] in needed:
                needed.update(line[2])
                retained.append(line)
        self.lines = retained[::-1]

    def operations(self) -> Operations:
        """Returns operations that record themselves."""
        table = {name: lambda *operands, name=name: self.record(name, *operands) for name in FUNCTIONS}
        return Operations(**table)


@final
class Recorded:
    """A symbolic number: the name of the variable that will hold it."""

    def __init__(self, tape: Tape, name: str) -> None:
        self.tape, self.name = tape, name

    def __bool__(self) -> bool:
        raise NotRecordableError("the equations branch on a number")

    def __float__(self) -> float:
        raise NotRecordableError("the equations turn a number into a float")

    __int__ = __index__ = __float__
    __hash__ = None  # type: ignore[assignment]  # equality records a comparison, so it cannot be a key

    def __neg__(self) -> Recorded:
        return self.tape.record("-{0}", self)

    def __pos__(self) -> Recorded:
        return self.tape.record("+{0}", self)

    def __abs__(self) -> Recorded:
        return self.tape.record("abs({0})", self)


def _binary(form: str, *, swapped: bool = False, neutral: float | None = None) -> Callable[[Recorded, Any], Recorded]:
    """Returns an operator method; with the operand ``neutral`` it returns the number itself and records nothing."""

    def operation(self: Recorded, other: Any) -> Recorded:
        if neutral is not None and isinstance(other, float) and other == neutral:
            return self
        first, second = (other, self) if swapped else (self, other)
        return self.tape.record(form, first, second)

    return operation


# sums have no neutral operand: -0.0 + 0.0 is 0.0
for _name, _sign in {"add": "+", "sub": "-", "mul": "*", "truediv": "/", "pow": "**"}.items():
    _form, _one = f"{{0}} {_sign} {{1}}", 1.0 if _sign in "*/" else None
    setattr(Recorded, f"__{_name}__", _binary(_form, neutral=_one))
    setattr(Recorded, f"__r{_name}__", _binary(_form, swapped=True, neutral=_one if _sign == "*" else None))
for _name, _sign in {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}.items():
    setattr(Recorded, f"__{_name}__", _binary(f"{{0}} {_sign} {{1}}"))


for _name, _called in {**dict.fromkeys(("sin", "cos", "tan", "tanh", "exp", "sqrt"), ""), "arctan": "atan"}.items():
    # NumPy calls a method of an object by the name of its function: np.sin(number) is recorded, too
    setattr(Recorded, _name, lambda self, form=_called or _name: self.tape.record(form, self))


def name_of(operand: Any) -> str:
    """Returns the variable's name, or a constant as source that gives back its exact value."""
    if isinstance(operand, Recorded):
        return operand.name
    # a bool is an int in Python, but the result of a comparison that was made instead of recorded
    if isinstance(operand, bool) or not isinstance(operand, (float, int)):
        raise NotRecordableError(f"got a {type(operand).__name__} among numbers")
    return f"({operand!r})" if isinstance(operand, int) else f"({float(operand)!r})"
