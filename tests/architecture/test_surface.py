"""What packages show, and how large their parts may grow."""

from __future__ import annotations

import ast
import importlib
import pkgutil
from pathlib import Path

import pytest

import safedpa
import safedpa_lab
import safedpa_services
import safedpa_sim

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(path for folder in ("shared", "services", "sim") for path in (ROOT / folder).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
LONGEST_FILE = 450
LONGEST_FUNCTION = 60

PACKAGES = sorted(
    info.name
    for package in (safedpa, safedpa_services, safedpa_sim, safedpa_lab)
    for info in pkgutil.walk_packages(package.__path__, package.__name__ + ".")
    if info.ispkg
)


@pytest.mark.parametrize("name", PACKAGES)
def test_all_is_complete_and_importable(name: str) -> None:
    package = importlib.import_module(name)
    assert package.__file__ is not None
    tree = ast.parse(Path(package.__file__).read_text(encoding="utf-8"))
    brought_in = {
        alias.asname or alias.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module != "__future__"
        for alias in node.names
    }
    shown = list(getattr(package, "__all__", []))
    for public in shown:
        assert hasattr(package, public), public
    if name.startswith("safedpa."):  # the library; what programs bring in is their own affair
        assert {public for public in brought_in if not public.startswith("_")} - {"TYPE_CHECKING", "Any"} <= set(shown)
    assert len(set(shown)) == len(shown)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_modules_say_what_they_are_and_what_they_show(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert ast.get_docstring(tree), "a module begins with what it is"
    names = {
        target.id
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    defined = {node.name for node in tree.body if isinstance(node, (ast.ClassDef, ast.FunctionDef))}
    if "__all__" not in names or path.name in ("__init__.py", "__main__.py"):
        return
    shown = importlib.import_module(".".join(path.with_suffix("").relative_to(ROOT).parts[1:])).__all__
    assert {name for name in defined if not name.startswith("_")} <= {*shown}, "public, but not in __all__"


@pytest.mark.parametrize("path", [*SOURCES, *TESTS], ids=lambda path: str(path.relative_to(ROOT)))
def test_files_and_functions_stay_small(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.count("\n") <= LONGEST_FILE
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            length = (node.end_lineno or node.lineno) - node.lineno + 1
            assert length <= LONGEST_FUNCTION, f"{node.name}: {length} lines"


def test_no_file_knows_this_machine_or_a_package_index() -> None:
    banned = ["/work/" + "main", "/root" + "/", "pypi" + ".org", "index" + "-url", "find" + "-links"]
    for pattern in ("*.py", "*.toml", "*.md", "*.txt", "Makefile", "*.yml"):
        for path in ROOT.rglob(pattern):
            parts = path.relative_to(ROOT).parts
            if any(part.startswith(".") and part != ".ci" for part in parts) or parts[0] in ("runs", "build", "dist"):
                continue
            text = path.read_text(encoding="utf-8", errors="replace")
            assert not [word for word in banned if word in text], path
