"""Small faults, one at a time: every place in a module where a sign, a limit or a number could be wrong."""

from __future__ import annotations

import ast
import copy
from collections.abc import Collection, Iterator
from dataclasses import dataclass

__all__ = ["Mutant", "assigned", "home_of", "mutants"]

_COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
}
_NAMES = {
    "min": "max",
    "max": "min",
    "minimum": "maximum",
    "maximum": "minimum",
    "sin": "cos",
    "cos": "sin",
    "any": "all",
    "all": "any",
}


@dataclass(frozen=True)
class Mutant:
    """A module's source with one fault; ``name`` says which, in words that do not depend on line numbers."""

    name: str
    line: int
    source: str
    lines: Collection[int]
    """Of the innermost statement around it, of a compound one its head: whoever runs none of them cannot notice. Of a
    constant those of the functions that read it."""
    function: str
    """Qualified name of the outermost function whose body it is in; empty in a module's or class's own body."""
    made: Collection[int] = ()
    """Lines that make the function it is in, where that stands in another one: if they run while modules are imported,
    what they made then stays what it was, whatever becomes of the outer function."""
    constant: str = ""
    """Name of the module's private constant that it is in, which nothing but functions reads; empty: it is in none."""


def mutants(source: str) -> list[Mutant]:
    """Every mutant of a module's source.

    Annotations, decorators, messages and docstrings are left alone, and ``strict=True``: it guards against lengths that
    are equal wherever the program is right, so that no test could tell it from False.
    """
    tree, found, seen = ast.parse(source), [], {}
    lines = source.splitlines()
    for path in _paths(tree):
        for change in _changes(_at(tree, path)):
            mutated = copy.deepcopy(tree)
            _replace(mutated, path, change)
            text = ast.unparse(ast.fix_missing_locations(mutated))
            line = getattr(_at(tree, path), "lineno", 1)
            name = f"{lines[line - 1].strip()}  ->  {_short(_at(tree, path))} becomes {_short(change)}"
            seen[name] = seen.get(name, 0) + 1
            named = f"{name} ({seen[name]})" if seen[name] > 1 else name
            home, constant = _home(tree, path), _constant(tree, path)
            found.append(
                Mutant(named, line, text, *home, _making(tree, path))
                if constant is None
                else Mutant(named, line, text, *constant)
            )
    return found


def _constant(tree: ast.Module, path: Path) -> tuple[Collection[int], str, Collection[int], str] | None:
    """The lines of the functions that read the private constant a place is in, no function, and its name."""
    statement = tree.body[path[0][1] or 0] if path else tree
    name = assigned(statement)
    if not name.startswith("_") or name.startswith("__"):
        return None
    bodies = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    inside = {id(inner) for node in bodies for part in node.body for inner in ast.walk(part)}
    reads = [
        node for node in ast.walk(tree) if isinstance(node, ast.Name) and node.id == name and node is not statement
    ]
    if any(id(node) not in inside for node in reads if isinstance(node.ctx, ast.Load)):
        return None
    lines = {
        line
        for node in bodies
        if any(read in ast.walk(node) for read in reads)
        for line in range(node.body[0].lineno, (node.end_lineno or node.lineno) + 1)
    }
    return frozenset(lines), "", (), name


def home_of(tree: ast.Module, source: str, first: int, end: int) -> tuple[Collection[int], str, Collection[int], str]:
    """What a ``Mutant`` wants to know of the place between two bytes: lines, function, what makes it, constant."""
    starts = [0]
    for line in source.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def is_there(node: ast.AST) -> bool:
        if not isinstance(node, (ast.stmt, ast.expr, ast.keyword, ast.ExceptHandler, ast.arg)):
            return False
        last = starts[(node.end_lineno or node.lineno) - 1] + (node.end_col_offset or 0)
        return (starts[node.lineno - 1] + node.col_offset, last) == (first, end)

    path = next(path for path in _paths(tree) if is_there(_at(tree, path)))
    return _constant(tree, path) or (*_home(tree, path), _making(tree, path), "")


def assigned(statement: ast.AST) -> str:
    """The name that a statement alone gives a value; empty where it is no such statement."""
    match statement:
        case ast.Assign(targets=[ast.Name(id=name)]) | ast.AnnAssign(target=ast.Name(id=name), value=ast.expr()):
            return name
    return ""


def _home(tree: ast.AST, path: Path) -> tuple[range, str]:
    """The lines of the statement that a place is in, and the function whose body it is in."""
    node, statement, names, inside = tree, tree, list[str](), ""
    for field, index in path:
        if not inside and isinstance(node, (ast.ClassDef, ast.FunctionDef)) and field == "body":
            names.append(node.name)
            inside = "" if isinstance(node, ast.ClassDef) else ".".join(names)
        value = getattr(node, field)
        node = value if index is None else value[index]
        statement = node if isinstance(node, ast.stmt) else statement
    first, body = getattr(statement, "lineno", 1), getattr(statement, "body", None)
    last = body[0].lineno - 1 if body else getattr(statement, "end_lineno", first)
    return range(first, max(first, last) + 1), inside


def _making(tree: ast.AST, path: Path) -> Collection[int]:
    """The lines on which functions begin whose body a place is in, without the outermost."""
    around = [
        node
        for node, (field, _) in zip(_way(tree, path), path, strict=False)
        if field == "body" and isinstance(node, (ast.FunctionDef, ast.Lambda))
    ]
    return frozenset(node.lineno for node in around[1:])


def _way(tree: ast.AST, path: Path) -> Iterator[ast.AST]:
    """The nodes from the root to a place, without it."""
    for length in range(len(path)):
        yield _at(tree, path[:length])


Path = tuple[tuple[str, int | None], ...]


def _paths(node: ast.AST, path: Path = ()) -> Iterator[Path]:
    yield path
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "format_spec") or isinstance(node, ast.JoinedStr):
            continue
        for index, child in enumerate(value) if isinstance(value, list) else ((None, value),):
            if isinstance(child, ast.AST) and not (isinstance(child, ast.keyword) and child.arg == "strict"):
                yield from _paths(child, (*path, (field, index)))


def _at(tree: ast.AST, path: Path) -> ast.AST:
    node: ast.AST = tree
    for field, index in path:
        value = getattr(node, field)
        node = value if index is None else value[index]
    return node


def _replace(tree: ast.AST, path: Path, change: ast.AST) -> None:
    if not path:
        return
    parent, (field, index) = _at(tree, path[:-1]), path[-1]
    if index is None:
        setattr(parent, field, change)
    else:
        getattr(parent, field)[index] = change


def _changes(node: ast.AST) -> Iterator[ast.AST]:
    match node:
        case ast.Compare(ops=operators):
            for index, operator in enumerate(operators):
                for other in _COMPARISONS.get(type(operator), ()):
                    yield _with(node, ops=[*operators[:index], other(), *operators[index + 1 :]])
        case ast.BinOp(op=operator) | ast.AugAssign(op=operator) if type(operator) in _OPERATORS:
            yield _with(node, op=_OPERATORS[type(operator)]())
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            yield copy.deepcopy(operand)
        case ast.BoolOp(op=operator):
            yield _with(node, op=ast.Or() if isinstance(operator, ast.And) else ast.And())
        case ast.Break():
            yield ast.copy_location(ast.Pass(), node)
        case ast.If(test=test) | ast.IfExp(test=test) if isinstance(test, (ast.Name, ast.Attribute, ast.Call)):
            yield _with(node, test=ast.UnaryOp(ast.Not(), test))
        case _:
            yield from _changed_word(node)


def _changed_word(node: ast.AST) -> Iterator[ast.AST]:
    match node:
        case ast.Constant(value=bool() as value):
            yield _with(node, value=not value)
        case ast.Constant(value=int() | float() as value):
            yield _with(node, value=value + 1)
        case ast.Name(id=name) if name in _NAMES:
            yield _with(node, id=_NAMES[name])
        case ast.Attribute(attr=name) if name in _NAMES:
            yield _with(node, attr=_NAMES[name])


def _with(node: ast.AST, **fields: object) -> ast.AST:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def _short(node: ast.AST) -> str:
    text = " ".join(ast.unparse(node).split())
    return text if len(text) <= 90 else text[:87] + "..."
