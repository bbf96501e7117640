"""Counts the house: lines and modules by room, modules that one other module alone imports, names, one decision's way.

python deploy/house.py              the table by room
python deploy/house.py --alone      the modules with one importer, next to it, by how long the two would be together,
                                    why they stand apart, and whether the laboratory imports them besides
python deploy/house.py --names      public classes of one name in shared, comparisons with names of states and actions,
                                    aliases of array types
python deploy/house.py --decision   the files of the package that one decision of the car's filter passes through

Counted are the product's folders (shared, services, sim without the laboratory). A line is code, blank, or text: a
comment or a docstring. What a package hands on from a module of its own counts as that module's import by anyone who
asks the package for it; the package itself is none. Programs (__main__) and packages' own files are not asked about.
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
from typing import Any

FOLDERS = ("shared", "services", "sim")
LABORATORY = "safedpa_lab"
MOST_LINES = 450
"""Of a file, as tests/architecture/test_surface.py holds it."""


_ASKED_NAMES = ("system.name", ".state_names", ".action_names")


@dataclass
class Module:
    """One file of the product."""

    name: str
    path: Path
    lines: int = 0
    blank: int = 0
    reported: int = 0
    importers: set[str] = field(default_factory=set)
    measured: bool = False
    """Whether the laboratory imports it."""

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
            if parts[0] == LABORATORY or path.name.startswith("generated_"):
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
        for asked, phrase in handed[name].items():
            if asked in found and not _only_handed_on(tree, phrase):
                found[asked].importers.add(name)
    for path in sorted((root / "sim" / LABORATORY).rglob("*.py")):
        for asked in _asked_for(ast.parse(path.read_text(encoding="utf-8")), LABORATORY, found, handed):
            found[asked].measured = True
    return found


def _counted(module: Module) -> Module:
    text = module.path.read_text(encoding="utf-8")
    rows = text.splitlines()
    reported: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT and rows[token.start[0] - 1].lstrip().startswith("#"):
            reported.add(token.start[0])
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            reported.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    blank = {number for number, row in enumerate(rows, 1) if not row.strip()}
    module.lines, module.blank, module.reported = len(rows), len(blank - reported), len(reported)
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


def _only_handed_on(tree: ast.Module, phrase: set[str]) -> bool:
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    return not phrase & used


def _asked_for(
    tree: ast.Module, name: str, found: dict[str, Module], handed: dict[str, dict[str, set[str]]]
) -> Iterator[str]:
    for module, word in _imports(tree):
        if f"{module}.{word}" in found:
            yield f"{module}.{word}"
        elif module in found:
            yield module
            yield from (
                part for part, phrase in handed[module].items() if word in phrase and part in found and part != name
            )


def alone(found: dict[str, Module]) -> list[Module]:
    """Modules that exactly one other one imports."""
    return [module for module in found.values() if module.asked and len(module.importers) == 1]


def why_apart(module: Module, found: dict[str, Module]) -> str:
    """Why a module does not stand with the one that imports it; nothing where they could be one."""
    importer = found[next(iter(module.importers))]
    if importer.path.name == "__main__.py":
        return "a program's work"
    if importer.room != module.room and not f"{importer.room}.".startswith(f"{module.room}."):
        return "another room"
    if module.lines + importer.lines > MOST_LINES:
        return "too long together"
    return "declared by a robot" if importer.path.name == "robot.py" else ""


def twice_named(found: dict[str, Module]) -> dict[str, list[str]]:
    """Public classes of ``safedpa`` by name, where several have one; of effects and systems one a robot is meant so."""
    places: dict[str, list[str]] = {}
    for module in found.values():
        parts = module.name.split(".")
        if parts[0] == "safedpa" and not {"robots", "effects"} <= set(parts):
            for node in ast.parse(module.path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    places.setdefault(node.name, []).append(module.name)
    return {name: where for name, where in sorted(places.items()) if len(where) > 1}


def array_aliases(found: dict[str, Module]) -> Counter[str]:
    """Module-level names for array types, as ``Values = NDArray[np.float64]``, and how many modules have each."""
    rows: Counter[str] = Counter()
    for module in found.values():
        for node in ast.parse(module.path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign) and ast.unparse(node.value).startswith("NDArray["):
                rows[ast.unparse(node)] += 1
    return rows


def asks_for_names(found: dict[str, Module]) -> list[str]:
    """Where code outside the robots' folders compares a system's names with names that stand there, by module:line."""
    rows = []
    for module in found.values():
        parts = module.name.split(".")
        if "robots" in parts or parts[0] == "safedpa_sim":
            continue
        for node in ast.walk(ast.parse(module.path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Compare):
                text = ast.unparse(node)
                written = any(isinstance(one, ast.Constant) and isinstance(one.value, str) for one in ast.walk(node))
                place = any(isinstance(one, ast.Name) and one.id.strip("_").isupper() for one in ast.walk(node))
                if (written or place) and any(word in text for word in _ASKED_NAMES):
                    rows.append(f"{module.name}:{node.lineno}: {text}")
    return rows


def decision_files() -> list[tuple[str, str, int, int]]:
    """(what is asked, status, most files of ``safedpa`` passed, most calls) over a drive of the car among obstacles.

    Asked are ``SafetyFilter.decide`` alone and the whole step of the filter's service, each in a drive of its own.
    """
    from safedpa.runtime.node import SafetyFilterNode
    from safedpa.safety.filter import SafetyFilter

    rows = []
    for kind, method in ((SafetyFilter, "decide"), (SafetyFilterNode, "step")):
        statuses: dict[str, list[Counter[str]]] = {}
        for status, files in _driven(kind, method)[1:]:  # in the first tick much is loaded
            statuses.setdefault(status, []).append(files)
        for status, found in statuses.items():
            rows.append((f"{kind.__name__}.{method}", status, max(map(len, found)), max(map(Counter.total, found))))
    return rows


def _driven(kind: type, method: str) -> list[tuple[str, Counter[str]]]:
    """By tick the verdict's status, and the calls by file of the package beneath ``method`` of ``kind``."""
    import safedpa
    from safedpa.adaptation import AdaptationNode
    from safedpa.dynamics import load_model
    from safedpa.policy import PolicyNode
    from safedpa.runtime.node import SafetyFilterNode
    from safedpa.safety.defaults import settings_named
    from safedpa_sim.closed_loop import drive
    from safedpa_sim.robots.car.robot import CarRobot
    from safedpa_sim.robots.car.scene import Scene

    home = str(Path(safedpa.__file__).parent)
    asked, passed = getattr(kind, method), list[Counter[str]]()

    def traced(*given: Any, **named: Any) -> Any:
        passed.append(Counter())
        sys.setprofile(lambda frame, event, _: _pass(frame.f_code.co_filename, event, home, passed[-1]))
        try:
            return asked(*given, **named)
        finally:
            sys.setprofile(None)

    setattr(kind, method, traced)
    try:
        model = load_model("car")
        nodes = [AdaptationNode(model), PolicyNode(model), SafetyFilterNode(model, settings_named("car"))]
        ticks = list(drive(CarRobot(Scene.random(905, "box")), nodes, 100))
    finally:
        setattr(kind, method, asked)
    del passed[1 : 1 + len(passed) - len(ticks)]  # after the first tick a decision is rehearsed
    return [(str(tick.verdict.status), files) for tick, files in zip(ticks, passed, strict=True)]


def _pass(file: str, event: str, home: str, files: Counter[str]) -> None:
    if event == "call" and file.startswith(home):
        files[file] += 1


def table(found: dict[str, Module]) -> str:
    """Lines, modules and fragments by room, as Markdown."""
    rooms: dict[str, Counter[str]] = {}
    fragments = {module.name for module in alone(found)}
    for module in found.values():
        row = rooms.setdefault(module.room, Counter())
        row.update(lines=module.lines, blank=module.blank, reported=module.reported, modules=int(module.asked))
        row.update(alone=int(module.name in fragments))
    everything: Counter[str] = Counter()
    for row in rooms.values():
        everything.update(row)
    rows = ["| room | lines | code | text | blank | modules | with one importer |", "|---|---|---|---|---|---|---|"]
    for room, row in [*sorted(rooms.items(), key=lambda item: -item[1]["lines"]), ("all", everything)]:
        code = row["lines"] - row["reported"] - row["blank"]
        cells = (room, row["lines"], code, row["reported"], row["blank"], row["modules"], row["alone"])
        rows.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(rows)


def main() -> None:
    """Prints what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--alone", action="store_true", help="list the modules with one importer")
    what.add_argument("--names", action="store_true", help="list classes of one name, and aliases of array types")
    what.add_argument("--decision", action="store_true", help="count the files that one decision passes through")
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parents[1])
    given = parser.parse_args()
    if given.decision:
        lines = [f"{asked}: {status}: {files} files, {calls} calls" for asked, status, files, calls in decision_files()]
    else:
        found = modules(given.root)
        lines = _alone_lines(found) if given.alone else _name_lines(found) if given.names else [table(found)]
    sys.stdout.write("\n".join(lines) + "\n")


def _alone_lines(found: dict[str, Module]) -> list[str]:
    rows, reasons = [], Counter[str]()
    for module in alone(found):
        importer = next(iter(module.importers))
        reason = why_apart(module, found) or "could be one"
        reasons[reason] += 1
        together = module.lines + found[importer].lines
        besides = ", and the laboratory" if module.measured else ""
        rows.append((together, f"{together:5d} {module.lines:5d} {module.name} <- {importer}{besides}: {reason}"))
    reported = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
    besides = sum(module.measured for module in alone(found))
    return [
        *(row for _, row in sorted(rows)),
        f"{len(rows)}: {reported}; {besides} of them the laboratory imports, too",
    ]


def _name_lines(found: dict[str, Module]) -> list[str]:
    rows = [f"{name}: {', '.join(where)}" for name, where in twice_named(found).items()]
    aliases, asking = array_aliases(found), asks_for_names(found)
    return [
        *rows,
        f"{len(rows)} names of several public classes",
        *asking,
        f"{len(asking)} comparisons of a system's names with names that stand there",
        *(f"{count:5d} {alias}" for alias, count in aliases.most_common()),
        f"{aliases.total()} aliases of array types",
    ]


if __name__ == "__main__":
    main()
