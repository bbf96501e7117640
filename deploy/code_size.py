"""Prints the size of the code by package, repeated names, and the files that one decision passes through.

python deploy/code_size.py              lines and modules by package
python deploy/code_size.py --names      repeated class names, comparisons with names of states, array types
python deploy/code_size.py --decision   the files of the package that one decision of the car's filter passes through

Counts shared, services and sim without the laboratory and without generated code. A line is code, text (a comment or a
docstring) or blank.
"""

from __future__ import annotations

import argparse
import ast
import io
import sys
import tokenize
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FOLDERS = ("shared", "services", "sim")
LABORATORY = "safedpa_lab"
_ASKED_NAMES = ("system.name", ".state_names", ".action_names")


@dataclass
class Module:
    """One file of the product."""

    name: str
    path: Path
    lines: int = 0
    blank: int = 0
    text: int = 0

    @property
    def package(self) -> str:
        """The package of second level."""
        parts = self.name.split(".")
        return ".".join(parts[:2]) if len(parts) > 2 or self.path.name == "__init__.py" else parts[0]


def modules(root: Path) -> dict[str, Module]:
    """Every module of the product under ``root``."""
    found = {}
    for folder in FOLDERS:
        for path in sorted((root / folder).rglob("*.py")):
            parts = path.relative_to(root / folder).with_suffix("").parts
            if parts[0] == LABORATORY or path.name.startswith("generated_"):
                continue
            name = ".".join(parts).removesuffix(".__init__")
            found[name] = _counted(Module(name, path))
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
    module.lines, module.blank, module.text = len(rows), len(blank - reported), len(reported)
    return module


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
    """Lines and modules by package, as Markdown."""
    packages: dict[str, Counter[str]] = {}
    for module in found.values():
        row = packages.setdefault(module.package, Counter())
        row.update(lines=module.lines, blank=module.blank, text=module.text, modules=1)
    everything: Counter[str] = Counter()
    for row in packages.values():
        everything.update(row)
    rows = ["| package | lines | code | text | blank | modules |", "|---|---|---|---|---|---|"]
    for package, row in [*sorted(packages.items(), key=lambda item: -item[1]["lines"]), ("all", everything)]:
        code = row["lines"] - row["text"] - row["blank"]
        rows.append(f"| {package} | {row['lines']} | {code} | {row['text']} | {row['blank']} | {row['modules']} |")
    return "\n".join(rows)


def main() -> None:
    """Prints what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--names", action="store_true", help="list classes of one name, and aliases of array types")
    what.add_argument("--decision", action="store_true", help="count the files that one decision passes through")
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parents[1])
    given = parser.parse_args()
    if given.decision:
        lines = [f"{asked}: {status}: {files} files, {calls} calls" for asked, status, files, calls in decision_files()]
    else:
        found = modules(given.root)
        lines = _name_lines(found) if given.names else [table(found)]
    sys.stdout.write("\n".join(lines) + "\n")


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
