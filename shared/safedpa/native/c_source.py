"""Writes recorded equations as C functions, whose results equal those of NumPy.

A recording is straight-line code. Constants become entries of an array ``k``, so that a model with other parameters, or
a scene with other numbers, is the same source and needs no compiler again. There is no other state: functions read
their arguments and write their results, so threads may share them.

Minimum, maximum, clip and sign return NaN if an operand is NaN, as in NumPy. All arithmetic, ``sqrt`` and comparisons
give the same bits as NumPy; sine, tangent, exponential and others are those of the C library, as in Python's ``math``,
and may differ from NumPy's own in the last bit.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Final, final

from safedpa.equations.slopes import operand_slopes, sum_of
from safedpa.equations.tape import FUNCTIONS, Line, NotRecordableError
from safedpa.native.tracing import RecordedFunction

__all__ = ["PRELUDE", "Constants", "c_choice", "c_lines", "function_source", "slope_lines"]

PRELUDE: Final = """#include <math.h>
#include <string.h>

static inline double minimum(double a, double b) { return a != a ? a : b != b ? b : b < a ? b : a; }
static inline double maximum(double a, double b) { return a != a ? a : b != b ? b : b > a ? b : a; }
static inline double clip(double x, double low, double high) { return minimum(maximum(x, low), high); }
static inline double sign(double x) { return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : x == 0.0 ? 0.0 : x; }
static inline double root_of_squares(double a, double b)
{
    const double square = a * a + b * b;
    /* beyond these bounds the squares underflow or overflow */
    return square > 1e-290 && square < 1e290 ? sqrt(square) : hypot(a, b);
}
"""
_FUNCTIONS: Final[Mapping[str, str]] = {"absolute": "fabs", "abs({0})": "fabs"}
_LITERAL: Final = (0.0, 0.5, 1.0, 2.0)
"""Constants that appear as they are: they belong to the form of an equation rather than to its parameters."""
_COMPARISON: Final = re.compile(r"\{0\} (<|<=|>|>=|==|!=) \{1\}")
_CONSTANT: Final = re.compile(r"\(.*\)", re.DOTALL)
_POWER: Final = "{0} ** {1}"


def c_choice(condition: str, yes: str, no: str) -> str:
    """Returns the choice as a C expression."""
    return f"({condition} ? {yes} : {no})"


@final
class Constants:
    """The values of a recording's constants, in the order of the array ``k``."""

    def __init__(self) -> None:
        self.values: list[float] = []
        self._known: dict[str, str] = {}

    def operand(self, name: str) -> str:
        """Returns a variable as it is, and a constant as a literal or as an entry of ``k``."""
        if not _CONSTANT.fullmatch(name):
            return name
        if name not in self._known:
            value = _value(name)
            if value in _LITERAL and not (value == 0.0 and str(value) != "0.0"):
                self._known[name] = repr(value)
            else:
                self._known[name] = f"k[{len(self.values)}]"
                self.values.append(value)
        return self._known[name]


def _value(name: str) -> float:
    text = name[1:-1]
    return float(text) if text.lstrip("-") in ("inf", "nan") else float(ast.literal_eval(text))


def c_lines(lines: Sequence[Line], constants: Constants, *, squares: bool = False) -> list[tuple[str, str]]:
    """Returns (variable, expression) for each operation.

    ``squares``: hypot as the root of a sum of squares, as in the rows of barriers. Raises NotRecordableError for an
    operation that C does not have, such as a call of a network.
    """
    return [(name, _expression(form, operands, constants, squares)) for name, form, operands in lines]


def _expression(form: str, names: Sequence[str], constants: Constants, squares: bool) -> str:
    if form == _POWER:
        return _power(names, constants)
    operands = [constants.operand(name) for name in names]
    if _COMPARISON.fullmatch(form):
        return f"(double)({form.format(*operands)})"
    if form == "where":
        return c_choice(*operands)
    if form in FUNCTIONS or form == "abs({0})":
        name = "root_of_squares" if form == "hypot" and squares else _FUNCTIONS.get(form, form)
        return f"{name}({', '.join(operands)})"
    if not re.fullmatch(r"[-+]?\{0\}|\{0\} [-+*/] \{1\}", form):
        raise NotRecordableError("the equations call a function, such as a network")
    # a space after a sign: two of them in a row would be another operator
    return form.format(*operands) if "{1}" in form else f"{form[:-3]} {operands[0]}".strip()


def _power(names: Sequence[str], constants: Constants) -> str:
    base = constants.operand(names[0])
    if not _CONSTANT.fullmatch(names[1]):
        return f"pow({base}, {constants.operand(names[1])})"
    exponent = _value(names[1])
    # as NumPy does for arrays; a constant exponent belongs to the form, so it is no entry of k
    return f"{base} * {base}" if exponent == 2.0 else f"pow({base}, {exponent!r})"


def slope_lines(
    lines: Sequence[Line], constants: Constants, varied: Sequence[str], results: Sequence[str]
) -> tuple[list[tuple[str, str]], list[list[str]]]:
    """Returns lines for the slopes of the values in ``varied``, and the terms (results, varied) of the results.

    Forward mode by the rules of ``safedpa.equations.slopes``. Raises NotRecordableError for an operation without one.
    """
    known: dict[str, list[str]] = {name: ["1.0" if name == other else "0.0" for other in varied] for name in varied}
    none = ["0.0"] * len(varied)
    found: list[tuple[str, str]] = []
    for name, form, names in lines:
        if not any(operand in known for operand in names):
            continue
        operands = [operand if form == _POWER else constants.operand(operand) for operand in names]
        entries = []
        for index in range(len(varied)):
            terms = []
            for place, operand in enumerate(names):
                slope = known.get(operand, none)[index]
                if slope != "0.0":
                    terms.append(_slope(form, slope, name, operands, place))
            term = sum_of([term for term in terms if term != "0.0"])
            if term != "0.0" and not re.fullmatch(r"\w+|1\.0", term):
                found.append((f"{name}_{index}", term))
                term = f"{name}_{index}"
            entries.append(term)
        if any(entry != "0.0" for entry in entries):
            known[name] = entries
    return found, [known.get(result, none) for result in results]


def _slope(form: str, slope: str, own: str, operands: Sequence[str], place: int) -> str:
    try:
        return operand_slopes(form, slope, own, operands, c_choice)[place]
    except KeyError as error:
        raise NotRecordableError(f"no derivative is known of {error.args[0]}") from error


def function_source(
    name: str,
    recording: RecordedFunction,
    constants: Constants,
    arguments: Sequence[str],
    body: Callable[[RecordedFunction, Constants], Sequence[str]] | None = None,
    *,
    squares: bool = False,
) -> str:
    """Returns a C function of ``arguments`` (one array for each input), then k, that writes its results to ``out``.

    ``body`` adds lines after the values.
    """
    head = [
        f"const double {variable} = {argument}[{index}];"
        for argument, variables in zip(arguments, recording.inputs, strict=True)
        for index, variable in enumerate(variables)
    ]
    lines = [f"const double {n} = {e};" for n, e in c_lines(recording.lines, constants, squares=squares)]
    tail = [f"out[{i}] = {constants.operand(result)};" for i, result in enumerate(recording.results)]
    extra = body(recording, constants) if body is not None else ()
    taken = ", ".join(f"const double *{argument}" for argument in (*arguments, "k"))
    text = "\n    ".join([*head, *lines, *tail, *extra])
    return f"static void {name}({taken}, double *out)\n{{\n    {text}\n}}\n"
