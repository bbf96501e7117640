"""Translates recorded equations, as the Python source that they become, to C: the same operations in the same order.

The source is arithmetic on local variables, with choices and calls of ``math``; so C gives the same bits, except for
``hypot``, of which Python has an implementation of its own. Constants become entries of an array ``k``: models with
other parameters are the same C.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from typing import Any, Final, final

from safedpa.equations.tape import NotRecordableError

__all__ = ["Translator", "function_lines"]

_SIGNS: Final = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_COMPARISONS: Final = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
_CALLS: Final = {name: name for name in ("sin", "cos", "tan", "atan", "tanh", "cosh", "exp", "sqrt", "hypot")} | {
    "abs": "fabs",
    "float": "(double)",
}
_NAMES: Final = {"inf": "INFINITY", "nan": "NAN"}
_FORM: Final = (0.0, 0.5, 1.0, 2.0)
"""Constants that belong to the form of an equation rather than to its parameters."""


@final
class Translator:
    """Translates expressions, and collects their ``constants``, the entries of ``k``."""

    def __init__(self) -> None:
        self.constants: list[float] = []
        self._known: dict[str, str] = {}

    def expression(self, source: str) -> str:
        """Returns the C of a Python expression. Raises NotRecordableError for one that has none."""
        return self.value(ast.parse(source, mode="eval").body)

    def lines(self, lines: Sequence[str]) -> list[str]:
        """Returns the C of lines ``name = expression``."""
        return [
            f"const double {name} = {self.expression(term)};" for name, term in (one.split(" = ", 1) for one in lines)
        ]

    def value(self, node: ast.expr) -> str:
        """Returns the C of an expression, as a double."""
        if isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
            return self._constant(float(node.value))
        if isinstance(node, ast.Name):
            return _NAMES.get(node.id, node.id)
        if isinstance(node, ast.IfExp):
            return f"({self._condition(node.test)} ? {self.value(node.body)} : {self.value(node.orelse)})"
        if isinstance(node, ast.Compare):
            return f"(double)({self._condition(node)})"
        return self._operation(node)

    def _operation(self, node: ast.expr) -> str:
        if isinstance(node, ast.BinOp):
            first, second = self.value(node.left), self.value(node.right)
            power = isinstance(node.op, ast.Pow)
            return f"pow({first}, {second})" if power else f"({first} {_known(_SIGNS, node.op)} {second})"
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
            return f"({'-' if isinstance(node.op, ast.USub) else '+'}{self.value(node.operand)})"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _CALLS:
            return f"{_CALLS[node.func.id]}({', '.join(map(self.value, node.args))})"
        raise NotRecordableError("the equations call a function that C does not have, such as a network")

    def _condition(self, node: ast.expr) -> str:
        if not isinstance(node, ast.Compare):
            return f"({self.value(node)} != 0.0)"
        operands = list(map(self.value, (node.left, *node.comparators)))
        pairs = zip(operands[:-1], node.ops, operands[1:], strict=True)
        return "(" + " && ".join(f"{one} {_known(_COMPARISONS, sign)} {other}" for one, sign, other in pairs) + ")"

    def _constant(self, value: float) -> str:
        if value in _FORM and str(value) != "-0.0":
            return repr(value)
        key = repr(value)
        if key not in self._known:
            self._known[key] = f"k[{len(self.constants)}]"
            self.constants.append(value)
        return self._known[key]


def function_lines(text: str, arguments: Sequence[tuple[str, str]], translator: Translator) -> list[str]:
    """Returns the C of a recorded function's body, whose results go to ``out``, and a second table to ``g``.

    ``arguments`` are pairs (Python's name, C's array). Raises NotRecordableError for a function that has no C.
    """
    names, found = dict(arguments), list[str]()
    for statement in ast.parse(text).body[0].body:  # type: ignore[attr-defined]  # a def
        if isinstance(statement, ast.Assign):
            target = statement.targets[0]
            if isinstance(target, ast.List):
                array = names[ast.unparse(statement.value)]
                found += [f"const double {ast.unparse(one)} = {array}[{i}];" for i, one in enumerate(target.elts)]
            else:
                found.append(f"const double {ast.unparse(target)} = {translator.value(statement.value)};")
        elif isinstance(statement, ast.Return):
            found += _results(statement.value, translator)
    return found


def _results(value: ast.expr | None, translator: Translator) -> list[str]:
    tables = value.elts if isinstance(value, ast.Tuple) else [value]
    found = list[str]()
    for name, table in zip(("out", "g"), tables, strict=False):
        entries = [each for row in _entries(table) for each in (_entries(row) if isinstance(row, ast.List) else [row])]
        found += [f"{name}[{index}] = {translator.value(entry)};" for index, entry in enumerate(entries)]
    return found


def _entries(node: ast.expr | None) -> list[ast.expr]:
    if not isinstance(node, ast.List):
        raise NotRecordableError("the equations return no list")
    return node.elts


def _known(table: Mapping[Any, str], operator: ast.AST) -> str:
    try:
        return table[type(operator)]
    except KeyError as error:
        raise NotRecordableError(f"the equations use {type(operator).__name__}") from error
