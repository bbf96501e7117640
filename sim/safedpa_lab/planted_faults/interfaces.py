"""What one module of the product hands to another: fields, remembered attributes and keys of files, by syntax alone.

A name is an interface where one module writes it and another one reads it. Nothing is listed: what is written tomorrow
is an interface as well.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

__all__ = ["PRODUCT", "Interfaces", "handed_over", "interfaces_of"]

PRODUCT = ("shared/safedpa/**/*.py", "services/safedpa_services/**/*.py", "sim/safedpa_sim/**/*.py")


@dataclass(frozen=True)
class Interfaces:
    """The names that are handed over.

    :param attributes: set outside of ``__init__`` in one module, and read in another.
    :param fields: of each data class, the type of each field that is read in another module than it is given in.
    :param optional: of each data class, the fields that may be left out.
    :param keys: of dictionaries, such as the contents of files.
    """

    attributes: frozenset[str]
    fields: dict[str, dict[str, str]]
    optional: dict[str, frozenset[str]]
    keys: frozenset[str]


@dataclass(frozen=True)
class _Uses:
    """Which files write and read each name: attributes, keys of dictionaries, and ``Class.field``."""

    written: dict[str, set[Path]] = field(default_factory=lambda: defaultdict(set))
    read: dict[str, set[Path]] = field(default_factory=lambda: defaultdict(set))
    stored: dict[str, set[Path]] = field(default_factory=lambda: defaultdict(set))
    used: dict[str, set[Path]] = field(default_factory=lambda: defaultdict(set))
    given: dict[str, set[Path]] = field(default_factory=lambda: defaultdict(set))

    def add(self, path: Path, node: ast.AST, classes: Mapping[str, Mapping[str, ast.AnnAssign]]) -> None:
        """Adds what one node writes or reads."""
        match node:
            case ast.Attribute(attr=name, ctx=context):
                (self.written if isinstance(context, ast.Store) else self.read)[name].add(path)
            case ast.Subscript(slice=ast.Constant(value=str(name)), ctx=context):
                (self.stored if isinstance(context, ast.Store) else self.used)[name].add(path)
            case ast.Dict(keys=keys):
                for key in keys:
                    if isinstance(key, ast.Constant) and isinstance(key.value, str):
                        self.stored[key.value].add(path)
            case ast.Call(func=ast.Attribute(attr="get"), args=[ast.Constant(value=str(name)), *_]):
                self.used[name].add(path)
            case ast.Call() if _name_called(node) in classes:
                for name in _arguments(node, list(classes[_name_called(node)])):
                    self.given[f"{_name_called(node)}.{name}"].add(path)


@cache
def interfaces_of(root: Path) -> Interfaces:
    """Derives the interfaces of the product below ``root``."""
    files = {path for glob in PRODUCT for path in root.glob(glob) if not path.name.startswith("generated_")}
    trees = {path: list(ast.walk(ast.parse(path.read_text(encoding="utf-8")))) for path in sorted(files)}
    classes = {
        node.name: _declared(node) for nodes in trees.values() for node in nodes if isinstance(node, ast.ClassDef)
    }
    uses = _Uses()
    for path, nodes in trees.items():
        for node in nodes:
            uses.add(path, node, classes)
    fields = {
        owner: {name: ast.unparse(item.annotation) for name, item in own.items() if uses.read[name] - givers}
        for owner, own in classes.items()
        if (givers := set[Path]().union(*(uses.given[f"{owner}.{name}"] for name in own)))
    }
    return Interfaces(
        attributes=frozenset(name for name, paths in uses.written.items() if uses.read[name] - paths),
        fields={owner: own for owner, own in fields.items() if own},
        optional={
            owner: frozenset(name for name, item in classes[owner].items() if item.value is not None)
            for owner in fields
        },
        keys=frozenset(name for name, paths in uses.stored.items() if uses.used[name] - paths),
    )


def _declared(node: ast.ClassDef) -> dict[str, ast.AnnAssign]:
    items = [item for item in node.body if isinstance(item, ast.AnnAssign)]
    return {item.target.id: item for item in items if isinstance(item.target, ast.Name)}


def handed_over(node: ast.AST, known: Interfaces) -> Iterator[ast.AST]:
    """A hand-over does not happen, or gives one value in place of another."""
    match node:
        case ast.Assign(targets=[ast.Attribute(attr=name)]) if name in known.attributes:
            yield ast.Pass()
        case ast.Assign(targets=[ast.Subscript(slice=ast.Constant(value=str(name)))]) if name in known.keys:
            yield ast.Pass()
        case ast.Assign(targets=[ast.Tuple(elts=targets)], value=ast.Tuple(elts=values)) if len(targets) == len(values):
            for index, target in enumerate(targets):
                if isinstance(target, ast.Attribute) and target.attr in known.attributes:
                    yield _without(targets, values, index)
        case ast.Dict(keys=keys, values=values) if len(keys) > 1:
            for index, key in enumerate(keys):
                if isinstance(key, ast.Constant) and key.value in known.keys:
                    yield ast.Dict(keys[:index] + keys[index + 1 :], values[:index] + values[index + 1 :])
        case ast.Call(func=ast.Attribute(attr="get"), args=[ast.Constant(value=str(name)), default]):
            if name in known.keys:
                yield default
        case ast.Call(func=ast.Name(id="replace")):
            fields = {name for own in known.fields.values() for name in own}
            yield from (_less(node, keyword) for keyword in node.keywords if keyword.arg in fields)
        case ast.Call() if _name_called(node) in known.fields:
            yield from _otherwise(node, known)


def _otherwise(node: ast.Call, known: Interfaces) -> Iterator[ast.AST]:
    """The call of a data class with a field left out, or with two of one type in each other's place."""
    owner = _name_called(node)
    types, optional = known.fields[owner], known.optional[owner]
    for keyword in node.keywords:
        if keyword.arg in types and keyword.arg in optional:
            yield _less(node, keyword)
    own = [keyword for keyword in node.keywords if keyword.arg in types]
    for index, one in enumerate(own):
        for other in own[index + 1 :]:
            if types[one.arg or ""] == types[other.arg or ""]:
                swapped = {one.arg: other.value, other.arg: one.value}
                rest = [ast.keyword(each.arg, swapped.get(each.arg, each.value)) for each in node.keywords]
                yield ast.Call(node.func, node.args, rest)
                break


def _without(targets: Sequence[ast.expr], values: Sequence[ast.expr], index: int) -> ast.AST:
    left = [target for place, target in enumerate(targets) if place != index]
    right = [value for place, value in enumerate(values) if place != index]
    if len(left) == 1:
        return ast.Assign([left[0]], right[0], lineno=1)
    return ast.Assign([ast.Tuple(left, ast.Store())], ast.Tuple(right, ast.Load()), lineno=1)


def _less(node: ast.Call, left_out: ast.keyword) -> ast.AST:
    return ast.Call(node.func, node.args, [keyword for keyword in node.keywords if keyword is not left_out])


def _name_called(node: ast.Call) -> str:
    """The last name of what is called; empty if it has none."""
    match node.func:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name
    return ""


def _arguments(node: ast.Call, names: Sequence[str]) -> list[str]:
    return [*names[: len(node.args)], *(keyword.arg for keyword in node.keywords if keyword.arg is not None)]
