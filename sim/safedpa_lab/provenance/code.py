"""The code that a command depends on, and digests of it that change when what it does may change."""

from __future__ import annotations

import ast
import hashlib
import re
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

_OURS = ("safedpa", "safedpa_services", "safedpa_sim", "safedpa_lab")
_FROM = re.compile(r"^\s*from (safedpa\w*(?:\.\w+)*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)
_IMPORT = re.compile(r"^\s*import (safedpa\w*(?:\.\w+)*)", re.MULTILINE)
_NAMED = re.compile(r"""["'](safedpa_\w+(?:\.\w+)*)(\.\{)?""")
"""A module in a string: of a process to start, or "package.{name}", which may be any of the package."""
_MAY_BE_COMMENT = re.compile(r"^\s*#", re.MULTILINE)
"""A line that is a comment, unless it is within a string: most files have none, and all strings need not be found."""
_COMMAND_LINE = "safedpa_services"
"""Started as a process it may come to any of the services."""
_CHANGES_NOTHING = ("safedpa_lab.provenance", "safedpa_services.command_line.group")
"""What is behind every command and behind no figure: this room, and the finding of a command by its name."""
_BY_NAME = ("safedpa.robots", "safedpa_sim.robots")
"""Packages whose modules are found at run time, by the name of a robot: everything in them counts."""
DATA = {"shipped models": (("safedpa", "*.toml"), ("safedpa", "*.safetensors"), ("safedpa_sim", "*.safetensors"))}
"""What is read next to code: models, settings with their margins, and weights, by package and pattern."""


def digests(module: str) -> dict[str, str]:
    """For each package that the module uses, twelve digits that change with the behaviour of its files.

    Packages are those of one folder, such as "safedpa.safety". Comments, docstrings and empty lines do not count.
    Shipped data counts byte for byte.
    """
    rooms: dict[str, list[str]] = {}
    for name in code_behind(module):
        path = _file(name)
        assert path is not None
        room = name if path.name == "__init__.py" else name.rpartition(".")[0]
        rooms.setdefault(room, []).append(f"{name} {_digest(path)}")
    reported = {room: _short("\n".join(sorted(lines))) for room, lines in sorted(rooms.items())}
    return reported | {name: _data(patterns) for name, patterns in DATA.items()}


def code_behind(module: str) -> list[str]:
    """The module and every one of this project that it may come to, in order.

    By an import at the top or within a function, by its name in a string (as a process is started), or as a robot.
    """
    found, waiting = set[str](), [module, *(name for package in _BY_NAME for name in _within(package))]
    while waiting:
        name = waiting.pop()
        path = _file(name)
        if name not in found and path is not None and not name.startswith(_CHANGES_NOTHING):
            found.add(name)
            waiting += _leads_to(path)
    return sorted(found)


def without_text(source: str) -> str:
    """The lines that do something: neither empty, nor comments, nor of a string that stands alone, as docstrings do."""
    silent, whole = set[int](), ast.parse(source)
    waiting: list[ast.AST] = [whole]
    while waiting:
        node = waiting.pop()
        for statement in (*getattr(node, "body", ()), *getattr(node, "orelse", ()), *getattr(node, "handlers", ())):
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                silent |= set(range(statement.lineno, (statement.end_lineno or statement.lineno) + 1))
            elif isinstance(statement, ast.AST):
                waiting.append(statement)
    lines = enumerate(source.splitlines(), 1)
    within = _within_strings(whole) if _MAY_BE_COMMENT.search(source) else set()
    retained = ((number, line) for number, line in lines if number not in silent and line.strip())
    return "\n".join(line for number, line in retained if number in within or line.strip()[0] != "#")


def _within_strings(tree: ast.AST) -> set[int]:
    """Lines of strings after their first: a # that begins one is no comment."""
    strings = (node for node in ast.walk(tree) if isinstance(node, (ast.Constant, ast.JoinedStr)))
    return {line for node in strings for line in range(node.lineno + 1, (node.end_lineno or node.lineno) + 1)}


@cache
def _leads_to(path: Path) -> tuple[str, ...]:
    """Modules named in a file, each with the packages above it, whose ``__init__`` is run as well."""
    return tuple(sorted({part for name in _names(path.read_text(encoding="utf-8")) for part in _above(name)}))


def _names(source: str) -> Iterator[str]:
    for start, names in _FROM.findall(source):
        yield from (f"{start}.{name}" for name in re.findall(r"\w+", names))
    yield from _IMPORT.findall(source)
    for name, any_of_it in _NAMED.findall(source):
        yield from _within(name) if any_of_it or name == _COMMAND_LINE else (f"{name}.__main__",)


def _above(name: str) -> Iterator[str]:
    parts = name.split(".")
    return (".".join(parts[:count]) for count in range(1, len(parts) + 1))


@cache
def _file(name: str) -> Path | None:
    """Its source; None where there is no such module (a name within one is no module)."""
    root, *rest = name.split(".")
    spec = find_spec(root) if root in _OURS else None
    if spec is None or spec.origin is None:
        return None
    plain = Path(spec.origin).parent.joinpath(*rest)
    return next((path for path in (plain / "__init__.py", plain.with_suffix(".py")) if path.is_file()), None)


def _within(package: str) -> Iterator[str]:
    """The package, and every module below it."""
    source = _file(package)
    if source is not None and source.name == "__init__.py":
        for path in source.parent.rglob("*.py"):
            inner = path.relative_to(source.parent).with_suffix("").parts
            yield ".".join((package, *(part for part in inner if part != "__init__")))


@cache
def _digest(path: Path) -> str:
    return _short(without_text(path.read_text(encoding="utf-8")))


def _data(patterns: Iterable[tuple[str, str]]) -> str:
    summed = hashlib.sha256()
    for package, pattern in patterns:
        source = _file(package)
        for path in sorted(source.parent.rglob(pattern)) if source is not None else ():
            summed.update(path.name.encode() + b"\0" + path.read_bytes())
    return summed.hexdigest()[:12]


def _short(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]
