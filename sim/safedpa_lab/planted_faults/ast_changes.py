"""What a node of a syntax tree becomes where a developer slips: one function for each kind of slip."""

from __future__ import annotations

import ast
import copy
import re
from collections.abc import Iterator, Sequence

_EXTREMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "fmin": "fmax", "fmax": "fmin"}
_UNITS = {1000, 1e-3, 1e6, 1e-6, 1e9, 1e-9, 3.6, 60, 3600, 180, 100, 0.01, 9.81}
_PATIENCE = re.compile(r"patience|timeout|seconds|wait|deadline|grace|ticks|periods|_age|interval", re.IGNORECASE)
_DURABLE = re.compile(r"sync|flush|durab|replac|renam")
_ENDING = re.compile(r"kill|terminat|stop|signal|cancel")
_TURNED: dict[type[ast.cmpop], type[ast.cmpop]] = {ast.Lt: ast.Gt, ast.Gt: ast.Lt, ast.LtE: ast.GtE, ast.GtE: ast.LtE}


def turned(node: ast.AST) -> Iterator[ast.AST]:
    """A difference the other way round; a number without its minus or without abs."""
    match node:
        case ast.BinOp(left=left, op=ast.Sub(), right=right):
            yield ast.BinOp(right, ast.Sub(), left)
        case ast.UnaryOp(op=ast.USub(), operand=operand) if not ast.unparse(operand).endswith("inf"):
            yield operand
        case ast.Call(func=ast.Name(id="abs") | ast.Attribute(attr="abs"), args=[argument]):
            yield argument


def guard_gone(node: ast.AST) -> Iterator[ast.AST]:
    """A check that leads away (return, continue, raise) is never true; one of several conditions is left out."""
    if isinstance(node, ast.If) and not node.orelse and _leads_away(node.body):
        without = copy.deepcopy(node)
        without.test = ast.Constant(False)
        yield without
    yield from dropped(node)


def _leads_away(body: Sequence[ast.stmt]) -> bool:
    return isinstance(body[-1], (ast.Return, ast.Continue, ast.Raise, ast.Break))


def dropped(node: ast.AST) -> Iterator[ast.AST]:
    """One of several conditions is left out."""
    if isinstance(node, ast.BoolOp):
        for index in range(len(node.values)):
            rest = [value for place, value in enumerate(node.values) if place != index]
            yield rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest)


def other_extreme(node: ast.AST) -> Iterator[ast.AST]:
    """The smaller instead of the larger, and the other way round."""
    match node:
        case ast.Call(func=ast.Name(id=name)) if name in _EXTREMES:
            yield _called(node, ast.Name(_EXTREMES[name]))
        case ast.Call(func=ast.Attribute(value=value, attr=name)) if name in _EXTREMES:
            yield _called(node, ast.Attribute(value, _EXTREMES[name]))


def _called(node: ast.Call, function: ast.expr) -> ast.Call:
    return ast.Call(function, node.args, node.keywords)


def one_ahead(node: ast.AST) -> Iterator[ast.AST]:
    """One step later or earlier: another index, another end of a slice."""
    match node:
        case ast.Subscript(value=value, slice=ast.Slice(lower=lower, upper=upper, step=None)):
            match lower, upper:
                case ast.Constant(value=1), None:
                    yield ast.Subscript(value, ast.Slice(None, ast.UnaryOp(ast.USub(), ast.Constant(1))))
                case None, ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=1)):
                    yield ast.Subscript(value, ast.Slice(ast.Constant(1), None))
        case ast.Subscript(
            value=value, slice=ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=ast.Constant(value=1))
        ):
            yield ast.Subscript(value, left)
        case ast.Subscript(value=value, slice=ast.Name(id="k" | "index" | "step" | "tick" | "row" | "now" as name)):
            yield ast.Subscript(value, ast.BinOp(ast.Name(name), ast.Sub(), ast.Constant(1)))
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=ast.Constant(value=1)):
            yield left


def everything_used(node: ast.AST) -> Iterator[ast.AST]:
    """A choice of rows is not made; its opposite is."""
    match node:
        case ast.Subscript(value=value, slice=ast.Name() | ast.UnaryOp(op=ast.Invert())):
            yield value
        case ast.UnaryOp(op=ast.Invert(), operand=operand):
            yield operand
        case ast.Compare(left=left, ops=[ast.Eq() | ast.NotEq() as operator], comparators=comparators):
            other: ast.cmpop = ast.NotEq() if isinstance(operator, ast.Eq) else ast.Eq()
            yield ast.Compare(left, [other], comparators)
        case ast.ListComp() | ast.SetComp() | ast.GeneratorExp() | ast.DictComp() if node.generators[0].ifs:
            yield _with_first(node, ifs=[])


def spread(node: ast.AST) -> Iterator[ast.AST]:
    """A root, a divisor, a degree of freedom or a quantile is forgotten."""
    match node:
        case ast.Call(func=ast.Name(id="sqrt") | ast.Attribute(attr="sqrt"), args=[argument]):
            yield argument
        case ast.Call(keywords=keywords) if any(keyword.arg == "ddof" for keyword in keywords):
            yield ast.Call(node.func, node.args, [keyword for keyword in keywords if keyword.arg != "ddof"])
        case ast.BinOp(left=left, op=ast.Div(), right=_):
            yield left
        case ast.BinOp(left=left, op=ast.Sub(), right=ast.Constant(value=1)):
            yield left
        case ast.BinOp(left=ast.Constant(value=float() | int()), op=ast.Mult(), right=right):
            yield right
        case ast.BinOp(left=left, op=ast.Pow(), right=ast.Constant(value=2)):
            yield left


def field_left_out(node: ast.AST) -> Iterator[ast.AST]:
    """One of several things that are compared is not; one of several conditions is left out."""
    match node:
        case ast.Tuple(elts=elements) | ast.List(elts=elements) | ast.Set(elts=elements) if len(elements) > 1 and all(
            isinstance(element, (ast.Attribute, ast.Constant, ast.Compare)) for element in elements
        ):
            for index in range(len(elements)):
                yield type(node)([one for place, one in enumerate(elements) if place != index])
        case ast.Dict(keys=keys, values=values) if len(keys) > 1:
            for index in range(len(keys)):
                yield ast.Dict(keys[:index] + keys[index + 1 :], values[:index] + values[index + 1 :])
        case ast.ListComp() | ast.SetComp() | ast.GeneratorExp() | ast.DictComp():
            first = ast.Subscript(_listed(node.generators[0].iter), ast.Slice(ast.Constant(1)))
            yield _with_first(node, iter=first)
        case _:
            yield from dropped(node)


def _with_first(node: ast.expr, **fields: object) -> ast.expr:
    """The comprehension with another first loop."""
    changed = copy.deepcopy(node)
    for name, value in fields.items():
        setattr(changed.generators[0], name, value)  # type: ignore[attr-defined]
    return changed


def _listed(source: ast.expr) -> ast.expr:
    return ast.Call(ast.Name("list"), [source], [])


def unit_lost(node: ast.AST) -> Iterator[ast.AST]:
    """A factor between units is forgotten, or stands on the wrong side of the line."""
    match node:
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div() as operator, right=ast.Constant(value=value)) if (
            value in _UNITS
        ):
            yield left
            yield ast.BinOp(left, ast.Div() if isinstance(operator, ast.Mult) else ast.Mult(), ast.Constant(value))
        case ast.BinOp(left=ast.Constant(value=value), op=ast.Mult(), right=right) if value in _UNITS:
            yield right
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), args=[argument]) if name in (
            "radians",
            "degrees",
            "deg2rad",
            "rad2deg",
        ):
            yield argument


def later_wins(node: ast.AST) -> Iterator[ast.AST]:
    """An order is taken the other way round."""
    match node:
        case ast.Compare(left=left, ops=[operator], comparators=[right]) if type(operator) in _TURNED:
            yield ast.Compare(left, [_TURNED[type(operator)]()], [right])
        case _:
            yield from other_extreme(node)


def not_durable(node: ast.AST) -> Iterator[ast.AST]:
    """What makes a file durable, or puts it in its place, is not called."""
    yield from _not_called(node, _DURABLE)


def not_ended(node: ast.AST) -> Iterator[ast.AST]:
    """What ends a process, or ends it, is not called."""
    yield from _not_called(node, _ENDING)


def _not_called(node: ast.AST, names: re.Pattern[str]) -> Iterator[ast.AST]:
    match node:
        case ast.Expr(value=ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name))) if names.search(name):
            yield ast.Pass()


def longer(node: ast.AST) -> Iterator[ast.AST]:
    """What is waited for ten times longer than it is reported."""
    match node:
        case ast.Assign(targets=[ast.Name(id=name)], value=ast.Constant(value=int() | float() as value)):
            if _PATIENCE.search(name) and not isinstance(value, bool):
                yield ast.Assign(node.targets, ast.Constant(10 * value), lineno=1)
        case ast.AnnAssign(target=ast.Name(id=name), value=ast.Constant(value=int() | float() as value)):
            if _PATIENCE.search(name) and not isinstance(value, bool):
                yield ast.AnnAssign(node.target, node.annotation, ast.Constant(10 * value), node.simple)
        case ast.keyword(arg=str() as name, value=ast.Constant(value=int() | float() as value)):
            if _PATIENCE.search(name) and not isinstance(value, bool):
                yield ast.keyword(name, ast.Constant(10 * value))
        case ast.Compare(left=left, ops=[operator], comparators=[ast.Name() | ast.Attribute() as right]):
            if _PATIENCE.search(ast.unparse(right)) and not isinstance(operator, (ast.Is, ast.IsNot, ast.Eq, ast.In)):
                yield ast.Compare(left, [operator], [ast.BinOp(ast.Constant(10), ast.Mult(), right)])


def miscounted(node: ast.AST) -> Iterator[ast.AST]:
    """A sum that counts once, a count that does not rise, one of all instead of all."""
    match node:
        case ast.AugAssign(op=ast.Add()):
            yield ast.Pass()
        case ast.Call(func=ast.Name(id="any" | "all" as name)):
            yield _called(node, ast.Name("all" if name == "any" else "any"))
        case ast.Call(func=ast.Name(id="sum")) if len(node.args) == 1:
            yield ast.Call(ast.Name("max"), node.args, [ast.keyword("default", ast.Constant(0))])
        case ast.Call(func=ast.Attribute(value=value, attr="sum" | "any" | "all" as name)):
            yield _called(node, ast.Attribute(value, {"sum": "max", "any": "all", "all": "any"}[name]))
        case ast.Call(func=ast.Name(id="len"), args=[_]):
            yield ast.BinOp(node, ast.Sub(), ast.Constant(1))
        case ast.Compare(left=left, ops=[ast.Lt() | ast.Gt() as operator], comparators=[ast.Constant() as right]):
            yield ast.Compare(left, [_TURNED[type(operator)]()], [right])
