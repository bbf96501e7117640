"""Tests use public names: outside ``tests/internals`` none touches a private name or pins a constant of the product.

``python tests/architecture/test_public_names_only.py`` prints the figures; ``--list`` every place.

- *private*: a private name of the product that a test imports, reads as an attribute, patches, or names in a string.
- *pinned*: a constant of the product compared with a literal, or listed in a table by module path and name.
- *faked*: a call that is checked on a mock, or a third-party library that a test replaces.

A name is private if it starts with one underscore and the product defines it. A test's own objects are free to have
private names: what a test file defines itself is not counted.
"""

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PRODUCT = ("shared/safedpa", "services/safedpa_services", "sim/safedpa_sim", "sim/safedpa_lab")
OURS = ("safedpa", "safedpa_services", "safedpa_sim", "safedpa_lab")
INTERNALS = "tests/internals"
PRIVATE = re.compile(r"_[A-Za-z]\w*")
CONSTANT = re.compile(r"[A-Z][A-Z0-9]*(_[A-Z0-9]+)*")
NAMED_TUPLES = {"_asdict", "_fields", "_field_defaults", "_make", "_replace"}
PATCHES = {"setattr", "delattr", "setitem", "patch", "object"}
MOCK_CHECK = re.compile(r"assert_(any_call|has_calls|not_called|called\w*)|call_(args|args_list|count)|mock_calls")


@dataclass(frozen=True)
class Place:
    """One place where a test depends on the shape of the code."""

    path: str
    line: int
    kind: str
    name: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.kind}: {self.name}"


@cache
def private_names(root: Path = ROOT) -> frozenset[str]:
    """All private names that the product defines: functions, classes, attributes, constants, parameters of classes."""
    found = set[str]()
    for folder in PRODUCT:
        for path in sorted((root / folder).rglob("*.py")):
            found |= defined(ast.parse(path.read_text(encoding="utf-8")))
    return frozenset(found - NAMED_TUPLES)


def defined(tree: ast.AST) -> set[str]:
    """Private names that a file defines."""
    found = set[str]()
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                found.add(name)
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                found.add(name)
            case ast.alias(asname=str(name)):
                found.add(name)
    return {name for name in found if PRIVATE.fullmatch(name)}


@cache
def modules(root: Path = ROOT) -> frozenset[str]:
    """Import names of all modules of the product."""
    found = set[str]()
    for folder in PRODUCT:
        base = (root / folder).parent
        for path in (root / folder).rglob("*.py"):
            parts = path.relative_to(base).with_suffix("").parts
            found.add(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return frozenset(found)


def places(path: str, source: str, names: frozenset[str], paths: frozenset[str]) -> Iterator[Place]:
    """Each place of a test file that depends on the shape of the code.

    :param names: private names of the product.
    :param paths: import names of its modules.
    """
    tree = ast.parse(source)
    names -= defined(tree)
    imported = dict(imports(tree))
    yield from fakes(path, tree, imported)
    # a name that stands in a larger string is code of another process: `import _x`, `obj._x`
    inside = re.compile(r"(?:\bimport |\.|\bsetattr\(\w+, ['\"])(_[A-Za-z]\w*)")
    for node in ast.walk(tree):
        line = getattr(node, "lineno", 0)
        match node:
            case ast.ImportFrom(module=str(module)) if module.split(".")[0] in OURS:
                private = [part for part in module.split(".") if PRIVATE.fullmatch(part)]
                private += [alias.name for alias in node.names if PRIVATE.fullmatch(alias.name)]
                yield from (Place(path, line, "private", f"{module}.{name}") for name in private)
            case ast.Attribute(attr=name) if name in names:
                yield Place(path, line, "private", name)
            case ast.keyword(arg=str(name)) if name in names:
                yield Place(path, node.value.lineno, "private", name)
            case ast.Constant(value=str(text)):
                found = [text] if text in names else [name for name in inside.findall(text) if name in names]
                yield from (Place(path, line, "private", f"{name!r} in a string") for name in found)
            case ast.Compare(left=left, ops=[ast.Eq() | ast.Is()], comparators=[right]):
                for one, other in ((left, right), (right, left)):
                    if literal(other) and (name := constant(one, imported)):
                        yield Place(path, line, "pinned", name)
            case ast.Tuple(elts=elements) | ast.List(elts=elements) | ast.Call(args=elements):
                texts = [one.value for one in elements if isinstance(one, ast.Constant) and isinstance(one.value, str)]
                if any(module_of(text, paths) for text in texts):
                    yield from (Place(path, line, "pinned", text) for text in texts if CONSTANT.fullmatch(text))


def fakes(path: str, tree: ast.AST, imported: dict[str, str]) -> Iterator[Place]:
    """Each call that is checked on a mock, and each third-party library that is replaced."""
    for node in ast.walk(tree):
        match node:
            case ast.Attribute(attr=name) if MOCK_CHECK.fullmatch(name):
                yield Place(path, node.lineno, "faked", name)
            case ast.Call(func=ast.Attribute(attr=name), args=[_, *_]) if name in PATCHES:
                if library := foreign(node, imported):
                    yield Place(path, node.lineno, "faked", library)


def imports(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Each imported name with the module and name that it comes from."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from ((alias.asname or alias.name, f"{node.module}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.asname or alias.name.split(".")[0], alias.name if alias.asname else alias.name.split(".")[0]


def constant(node: ast.AST, imported: dict[str, str]) -> str:
    """Qualified name of a constant of the product that an expression reads; empty where it reads none."""
    match node:
        case ast.Name(id=name) if CONSTANT.fullmatch(name) and imported.get(name, "").split(".")[0] in OURS:
            return imported[name]
        case ast.Attribute(value=ast.Name(id=base), attr=name) if CONSTANT.fullmatch(name):
            home = imported.get(base, "")
            # a member of an enumeration is no constant: classes are capitalised
            return f"{home}.{name}" if home.split(".")[0] in OURS and home.rpartition(".")[2].islower() else ""
        case ast.Call(func=ast.Name(id="getattr"), args=[_, ast.Constant(value=str(name)), *_]):
            return name if CONSTANT.fullmatch(name) else ""
    return ""


def literal(node: ast.AST) -> bool:
    """Whether an expression is made of literals alone."""
    try:
        ast.literal_eval(node)
    except (ValueError, TypeError, SyntaxError):
        match node:
            case ast.Call(func=ast.Attribute(attr="approx"), args=[value, *_]):
                return literal(value)
            case ast.BinOp(left=left, right=right):
                return literal(left) and literal(right)
        return False
    return True


def module_of(text: str, paths: frozenset[str]) -> bool:
    """Whether a text is a module of the product, whole or without its first package."""
    return text in paths or ("." in text and any(f"{ours}.{text}" in paths for ours in OURS))


def foreign(call: ast.Call, imported: dict[str, str]) -> str:
    """The third-party library that a call patches; empty where it is the standard library's or the project's own."""
    target = call.args[0]
    if isinstance(target, ast.Constant) and isinstance(target.value, str):
        name = target.value
    else:
        while isinstance(target, ast.Attribute):
            target = target.value
        name = imported.get(target.id, "") if isinstance(target, ast.Name) else ""
    top = name.split(".")[0]
    if call.func.attr == "setitem":  # type: ignore[attr-defined]
        if name != "sys" or len(call.args) < 2 or not isinstance(call.args[1], ast.Constant):
            return ""
        # a library that is absent (None) is an installation without it, and no fake
        fake = len(call.args) > 2 and not (isinstance(call.args[2], ast.Constant) and call.args[2].value is None)
        top = str(call.args[1].value).split(".")[0] if fake else ""
    own = not top or top in OURS or top in sys.stdlib_module_names or top in scripts()
    return "" if own else f"{top} is replaced"


@cache
def scripts() -> frozenset[str]:
    """Names of the project's own scripts, which tests import by path."""
    return frozenset(path.stem for folder in ("deploy", "docs", "tests") for path in (ROOT / folder).rglob("*.py"))


@cache
def all_places(root: Path = ROOT, *, internals: bool = False) -> list[Place]:
    """Every place in the tests of a tree.

    :param internals: only those of ``tests/internals``; otherwise only the others.
    """
    found = list[Place]()
    for path in sorted((root / "tests").rglob("*.py")):
        name = path.relative_to(root).as_posix()
        if name.startswith(INTERNALS) == internals and name != "tests/architecture/test_public_names_only.py":
            found += places(name, path.read_text(encoding="utf-8"), private_names(root), modules(root))
    return found


@pytest.mark.long
@pytest.mark.parametrize("kind", ["private", "pinned", "faked"])
def test_outside_internals_no_test_depends_on_the_shape_of_the_code(kind: str) -> None:
    assert [str(place) for place in all_places() if place.kind == kind] == []


@pytest.mark.parametrize(
    ("source", "kinds"),
    [
        ("from safedpa.safety.solver.sqp import _posed", ["private"]),
        ("def test_it(s):\n    assert s._posed == 1", ["private"]),
        ("def test_it(s):\n    assert getattr(s, '_posed') == 1", ["private"]),
        ("def test_it(m):\n    m.setattr('safedpa.safety.solver.sqp._posed', None)", ["private"]),
        ("CODE = 'import safedpa; safedpa.search._posed()'", ["private"]),
        ("class Own:\n    def _posed(self): ...\n    def other(self): return self._posed()", []),
        ("from safedpa.safety.solver.sqp import LIMIT\nassert LIMIT == 3.0", ["pinned"]),
        ("from safedpa.safety import search\nassert search.LIMIT == 3.0", ["pinned"]),
        ("from safedpa.safety.solver.sqp import LIMIT\nassert number < LIMIT", []),
        ("TABLE = [('safedpa.safety.solver.sqp', 'LIMIT', 3.0)]", ["pinned"]),
        ("import matplotlib.pyplot\ndef test(m):\n    m.setattr(matplotlib.pyplot, 'plot', None)", ["faked"]),
        ("def test(mock):\n    mock.assert_called_once_with(3)", ["faked"]),
        ("import time\ndef test(m):\n    m.setattr(time, 'sleep', None)", []),
    ],
)
def test_a_place_is_found_by_its_kind(source: str, kinds: list[str]) -> None:
    found = places("tests/x.py", source, frozenset({"_posed"}), frozenset({"safedpa.safety.solver.sqp"}))
    assert [place.kind for place in found] == kinds


def main() -> None:
    """Prints the figures of this checkout, or of the one given by ``--root DIR``; with ``--list`` every place."""
    root = Path(sys.argv[sys.argv.index("--root") + 1]).resolve() if "--root" in sys.argv else ROOT
    found = all_places(root)
    if "--list" in sys.argv:
        print(*found, sep="\n")
    for kind in ("private", "pinned", "faked"):
        these = [place for place in found if place.kind == kind]
        print(f"{kind}: {len({place.path for place in these})} files, {len(these)} places")
    files = sorted((root / "tests").rglob("*.py"))
    lines = {path: path.read_text(encoding="utf-8").count("\n") for path in files}
    internals = {path for path in files if path.relative_to(root).as_posix().startswith(INTERNALS)}
    print(f"lines of tests: {sum(lines.values())}, of these internals: {sum(lines[path] for path in internals)}")


if __name__ == "__main__":
    main()
