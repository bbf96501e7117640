"""Counts the house: lines and modules by room, and modules that one other module alone imports.

python deploy/house.py           the table by room
python deploy/house.py --alone   the modules with one importer, beside it, by how long the two would be together

Counted are the product's folders (shared, services, sim without the laboratory). A line is code, blank, or told: a
comment or a docstring. What a package hands on from a module of its own counts as that module's import by whoever asks
the package for it; the package itself is none. Programs (__main__) and packages' own files are not asked about.
"""

from __future__ import annotations

import argparse
import ast
import io
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

FOLDERS = ("shared", "services", "sim")
LABORATORY = "safedpa_lab"


@dataclass
class Module:
    """One file of the product."""

    name: str
    path: Path
    lines: int = 0
    blank: int = 0
    told: int = 0
    importers: set[str] = field(default_factory=set)

    @property
    def room(self) -> str:
        """The package two floors down: what a folder of the house is."""
        parts = self.name.split(".")
        return ".".join(parts[:2]) if len(parts) > 2 or self.path.name == "__init__.py" else parts[0]

    @property
    def asked(self) -> bool:
        """Whether it can have importers: no program, and no package's own file."""
        return self.path.name not in ("__init__.py", "__main__.py")


def modules(root: Path) -> dict[str, Module]:
    """Every module of the product under ``root``, with its importers."""
    found = {}
    for folder in FOLDERS:
        for path in sorted((root / folder).rglob("*.py")):
            parts = path.relative_to(root / folder).with_suffix("").parts
            if parts[0] == LABORATORY:
                continue
            name = ".".join(parts).removesuffix(".__init__")
            found[name] = _counted(Module(name, path))
    trees = {name: ast.parse(module.path.read_text(encoding="utf-8")) for name, module in found.items()}
    handed = {name: _handed_on(trees[name], name, found) for name in found}
    for name, tree in trees.items():
        for asked in _asked_for(tree, name, found, handed):
            if asked != name and not asked.startswith(f"{name}.") | (not found[asked].asked):
                found[asked].importers.add(name)
    for name, tree in trees.items():  # a package that uses what it imports itself is an importer like any other
        for asked, words in handed[name].items():
            if asked in found and not _only_handed_on(tree, words):
                found[asked].importers.add(name)
    return found


def _counted(module: Module) -> Module:
    text = module.path.read_text(encoding="utf-8")
    rows = text.splitlines()
    told: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT and rows[token.start[0] - 1].lstrip().startswith("#"):
            told.add(token.start[0])
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            told.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    blank = {number for number, row in enumerate(rows, 1) if not row.strip()}
    module.lines, module.blank, module.told = len(rows), len(blank - told), len(told)
    return module


def _imports(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """(module, name) of each import; without a name where the module itself is imported."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)


def _handed_on(tree: ast.Module, name: str, found: dict[str, Module]) -> dict[str, set[str]]:
    """Of a package, its own modules and the names that it takes from each."""
    taken: dict[str, set[str]] = {}
    if found[name].path.name == "__init__.py":
        for module, word in _imports(tree):
            if module.startswith(f"{name}.") and word:
                taken.setdefault(module, set()).add(word)
    return taken


def _only_handed_on(tree: ast.Module, words: set[str]) -> bool:
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    return not words & used


def _asked_for(
    tree: ast.Module, name: str, found: dict[str, Module], handed: dict[str, dict[str, set[str]]]
) -> Iterator[str]:
    for module, word in _imports(tree):
        if f"{module}.{word}" in found:
            yield f"{module}.{word}"
        elif module in found:
            yield module
            yield from (
                part for part, words in handed[module].items() if word in words and part in found and part != name
            )


def alone(found: dict[str, Module]) -> list[Module]:
    """Modules that exactly one other one imports."""
    return [module for module in found.values() if module.asked and len(module.importers) == 1]


def table(found: dict[str, Module]) -> str:
    """Lines, modules and fragments by room, as Markdown."""
    rooms: dict[str, Counter[str]] = {}
    fragments = {module.name for module in alone(found)}
    for module in found.values():
        row = rooms.setdefault(module.room, Counter())
        row.update(lines=module.lines, blank=module.blank, told=module.told, modules=int(module.asked))
        row.update(alone=int(module.name in fragments))
    everything: Counter[str] = Counter()
    for row in rooms.values():
        everything.update(row)
    rows = ["| room | lines | code | told | blank | modules | with one importer |", "|---|---|---|---|---|---|---|"]
    for room, row in [*sorted(rooms.items(), key=lambda item: -item[1]["lines"]), ("all", everything)]:
        code = row["lines"] - row["told"] - row["blank"]
        rows.append(
            f"| {room} | {row['lines']} | {code} | {row['told']} | {row['blank']} | {row['modules']} | {row['alone']} |"
        )
    return "\n".join(rows)


def main() -> None:
    """Prints what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--alone", action="store_true", help="list the modules with one importer")
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parents[1])
    given = parser.parse_args()
    found = modules(given.root)
    if not given.alone:
        sys.stdout.write(table(found) + "\n")
        return
    pairs = [(module.lines + found[next(iter(module.importers))].lines, module) for module in alone(found)]
    for together, module in sorted(pairs, key=lambda pair: (pair[0], pair[1].name)):
        sys.stdout.write(f"{together:5d} {module.lines:5d} {module.name} <- {next(iter(module.importers))}\n")


if __name__ == "__main__":
    main()
