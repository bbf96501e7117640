"""Finds assertions that cannot fail: each one's operands are changed while the tests run, and it must become false.

    python deploy/mutation/assertions.py tests/replay [FILE OR FOLDER ...]

The tests run once, with their assertions rewritten: what stands in each is evaluated once, and asked beside it whether
the assertion would have failed with another operand. Told is an assertion that

- never ran, as in a loop over nothing, though tests of its function ran;
- looks through nothing whenever it runs (``all`` of no items);
- has an alternative after ``or`` that was true each time, or one that was never needed;
- compares an object with itself, or holds whatever stands on its left;
- is a function that is not called, or a tuple.

Of tests that were skipped it is counted how many were not asked, so that nobody takes them for good.

Exit code 1: there are some; 2: the tests fail as they are.
"""

from __future__ import annotations

import ast
import importlib.abc
import importlib.machinery
import importlib.util
import operator
import os
import sys
import types
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

import pytest

__all__ = ["Asked", "findings", "rewritten"]

_NAME = "__asked__"
_OPERATORS: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.In: lambda item, items: item in items,
    ast.NotIn: lambda item, items: item not in items,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
}
_FARTHEST = {"Lt": float("inf"), "LtE": float("inf"), "Gt": float("-inf"), "GtE": float("-inf")}


@dataclass
class Seen:
    """What was seen of one assertion."""

    place: str
    text: str
    ran: int = 0
    walks: dict[int, bool] = field(default_factory=dict)
    """By comprehension: whether it ever looked at an item."""
    truths: dict[int, list[tuple[bool, ...]]] = field(default_factory=dict)
    """By ``or``: of each time which alternatives were true."""
    same: int = 0
    """So many times an object was compared with itself, as where a condition chooses it."""
    deaf: dict[int, bool] = field(default_factory=dict)
    """By comparison: whether it held each time for whatever could stand on the left."""
    odd: str = ""
    function: str = ""
    """In which it stands."""


class Asked:
    """Beside the tests: asked by each rewritten assertion; as a plug-in of pytest it hears which are skipped."""

    def __init__(self) -> None:
        self.seen: list[Seen] = []
        self._skipped, self._ran = set[tuple[str, str]](), set[tuple[str, str]]()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Of a part of a test."""
        file, _, test = report.nodeid.partition("::")
        name = file, test.partition("[")[0].rpartition("::")[2]
        if report.skipped:
            self._skipped.add(name)
        elif report.when == "call":
            self._ran.add(name)

    def not_asked(self, seen: Seen) -> bool:
        """Whether it never ran since every test of its function was skipped."""
        name = seen.place.rpartition(":")[0], seen.function
        return not seen.ran and name in self._skipped - self._ran

    def held(self, number: int, value: Any) -> Any:
        """The assertion's own value."""
        seen = self.seen[number]
        seen.ran += 1
        if isinstance(value, (types.MethodType, types.BuiltinMethodType, types.FunctionType, types.GeneratorType)):
            seen.odd = f"a {type(value).__name__} is always true"
        return value

    def walked(self, number: int, which: int, items: Iterable[Any]) -> Iterator[Any]:
        """The items of a comprehension."""
        self.seen[number].walks.setdefault(which, False)
        for item in items:
            self.seen[number].walks[which] = True
            yield item

    def any_of(self, number: int, which: int, *alternatives: Callable[[], Any]) -> Any:
        """What ``or`` gives; all alternatives are looked at, one that cannot be is taken for false."""
        found: list[Any] = []
        truths: list[bool] = []
        for alternative in alternatives:
            try:
                value = alternative()
                truth = bool(value)
            except Exception:
                if not any(truths):
                    raise
                value, truth = False, False
            found.append(value)
            truths.append(truth)
        self.seen[number].truths.setdefault(which, []).append(tuple(truths))
        return next((value for value, truth in zip(found, truths, strict=True) if truth), found[-1])

    def compared(self, number: int, which: int, kind: str, left: Any, right: Any) -> Any:
        """What the comparison gives, after asking what another left side would give."""
        seen = self.seen[number]
        if kind == "Eq" and left is right and isinstance(left, (list, dict, set)):
            seen.same += 1
        if isinstance(right, (list, tuple, dict, set, frozenset, int, float, str, bytes)) and kind in ("Eq", "In"):
            other: Any = object()
            if not (kind == "In" and isinstance(right, (str, bytes))):
                seen.deaf[which] = seen.deaf.get(which, True) and bool(_OPERATORS[getattr(ast, kind)](other, right))
        elif kind in _FARTHEST and isinstance(left, (int, float)) and isinstance(right, (int, float)):
            holds = bool(_OPERATORS[getattr(ast, kind)](_FARTHEST[kind], right))
            seen.deaf[which] = seen.deaf.get(which, True) and holds
        return _OPERATORS[getattr(ast, kind)](left, right)


class _Rewriting(ast.NodeTransformer):
    """Of one assertion's test."""

    def __init__(self, number: int) -> None:
        self._number, self._count = number, 0

    def _asking(self, name: str, *arguments: ast.expr) -> ast.expr:
        function = ast.Attribute(ast.Name(_NAME, ast.Load()), name, ast.Load())
        self._count += 1
        return ast.Call(function, [ast.Constant(self._number), ast.Constant(self._count), *arguments], [])

    def visit_Lambda(self, node: ast.Lambda) -> ast.AST:
        """Runs later, or never."""
        return node

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.AST:
        """An ``or`` is asked alternative by alternative."""
        self.generic_visit(node)
        if isinstance(node.op, ast.And):
            return node
        nothing = ast.arguments([], [], None, [], [], None, [])
        return self._asking("any_of", *[ast.Lambda(nothing, value) for value in node.values])

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        """A comparison of two."""
        self.generic_visit(node)
        if len(node.ops) > 1:
            return node
        kind = ast.Constant(type(node.ops[0]).__name__)
        return self._asking("compared", kind, node.left, node.comparators[0])

    def visit_comprehension(self, node: ast.comprehension) -> ast.AST:
        """What is looked through."""
        self.generic_visit(node)
        if not node.is_async:
            node.iter = self._asking("walked", node.iter)
        return node


def rewritten(source: str, file: str, asked: Asked) -> ast.Module:
    """The module, its assertions asking ``asked`` under the name ``__asked__``."""
    tree = ast.parse(source)
    for function in ast.walk(tree):
        if not isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        inside = [node for node in ast.walk(function) if isinstance(node, ast.Assert) and not hasattr(node, "done")]
        for node in sorted(inside, key=lambda node: node.lineno):
            node.done = True  # type: ignore[attr-defined] - of a function within this one it is found again
            number = len(asked.seen)
            asked.seen.append(Seen(f"{file}:{node.lineno}", ast.unparse(node.test), function=function.name))
            if isinstance(node.test, ast.Tuple):
                asked.seen[number].odd = "a tuple is always true"
            if not any(isinstance(part, (ast.Await, ast.Yield, ast.NamedExpr)) for part in ast.walk(node.test)):
                node.test = _Rewriting(number).visit(node.test)
            held = ast.Attribute(ast.Name(_NAME, ast.Load()), "held", ast.Load())
            node.test = ast.Call(held, [ast.Constant(number), node.test], [])
    return ast.fix_missing_locations(tree)


def findings(asked: Asked) -> list[str]:
    """What is wrong, one line for each."""
    lines = []
    for seen in asked.seen:
        wrong = [seen.odd] if seen.odd else []
        if not seen.ran and not asked.not_asked(seen):
            wrong.append("never ran")
        if seen.same:
            wrong.append("compares an object with itself")
        if seen.walks and not all(seen.walks.values()):
            wrong.append("looks through nothing")
        if any(seen.deaf.values()):
            wrong.append("holds whatever stands on the left")
        for times in seen.truths.values():
            for place in range(len(times[0])):
                if all(truths[place] for truths in times):
                    wrong.append(f"alternative {place + 1} was true each time")
                elif not any(truths[place] and sum(truths) == 1 for truths in times):
                    wrong.append(f"alternative {place + 1} was never needed")
        if wrong:
            lines.append(f"{seen.place}: {'; '.join(wrong)}: {' '.join(seen.text.split())[:140]}")
    return lines


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads a file of tests with its assertions rewritten."""

    asked: Asked

    def get_code(self, fullname: str) -> types.CodeType:
        """Compiled anew, never from what was kept."""
        source = Path(self.path).read_text(encoding="utf-8")
        code: types.CodeType = compile(rewritten(source, os.path.relpath(self.path), self.asked), self.path, "exec")
        return code

    def exec_module(self, module: types.ModuleType) -> None:
        """Runs it."""
        module.__dict__[_NAME] = self.asked
        super().exec_module(module)


class _Finder(importlib.abc.MetaPathFinder):
    """Finds files of tests for the loader above, before pytest does."""

    def __init__(self, asked: Asked) -> None:
        self._asked = asked

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Of ``tests.folder.test_name`` and the like."""
        last = fullname.rpartition(".")[2]
        for folder in path or ():
            file = Path(folder) / f"{last}.py"
            if last.startswith("test_") and file.is_file():
                loader = _Loader(fullname, str(file))
                loader.asked = self._asked
                return importlib.util.spec_from_file_location(fullname, file, loader=loader)
        return None


def main(arguments: list[str]) -> int:
    """Runs the tests and tells."""
    asked = Asked()
    sys.meta_path.insert(0, _Finder(asked))
    plain = ["-q", "--assert=plain", "-p", "no:cacheprovider", "-p", "no:xdist"]
    failed = pytest.main([*plain, *arguments], plugins=[asked]) != 0
    told = findings(asked)
    left = sum(map(asked.not_asked, asked.seen))
    counted = f"{len(asked.seen)} assertions, {len(told)} to look at"
    counted += f", {left} not asked, of skipped tests" if left else ""
    sys.stdout.write("\n".join([*told, counted]) + "\n")
    return 2 if failed else 1 if told or not asked.seen else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
