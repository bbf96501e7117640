"""What packages show, and how large their parts may grow."""

from __future__ import annotations

import ast
import importlib
import pkgutil
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

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


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def not_so(check: Callable[[Any], str], items: Iterable[Any]) -> dict[str, str]:
    """What is wrong with each item, of those with which something is; one test with a list of all costs a second."""
    return {str(item): wrong for item in items if (wrong := check(item))}


def wrong_in_package(name: str) -> str:
    package = importlib.import_module(name)
    assert package.__file__ is not None
    brought_in = {
        alias.asname or alias.name
        for node in tree_of(Path(package.__file__)).body
        if isinstance(node, ast.ImportFrom) and node.module != "__future__"
        for alias in node.names
    }
    shown = list(getattr(package, "__all__", []))
    if missing := [public for public in shown if not hasattr(package, public)]:
        return f"shows what is not there: {missing}"
    brought_in = {public for public in brought_in if not public.startswith("_")} - {"TYPE_CHECKING", "Any"}
    if name.startswith("safedpa.") and not brought_in <= set(shown):  # of programs it is their own affair
        return f"not in __all__: {brought_in - set(shown)}"
    return "" if len(set(shown)) == len(shown) else "something is twice in __all__"


def wrong_in_module(path: Path) -> str:
    tree = tree_of(path)
    if not ast.get_docstring(tree):
        return "a module begins with what it is"
    names = {
        target.id
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    defined = {node.name for node in tree.body if isinstance(node, (ast.ClassDef, ast.FunctionDef))}
    if "__all__" not in names or path.name in ("__init__.py", "__main__.py"):
        return ""
    shown = importlib.import_module(".".join(path.with_suffix("").relative_to(ROOT).parts[1:])).__all__
    hidden = {name for name in defined if not name.startswith("_")} - {*shown}
    return f"public, but not in __all__: {hidden}" if hidden else ""


def too_large(path: Path) -> str:
    found = [f"{lines} lines"] if (lines := path.read_text(encoding="utf-8").count("\n")) > LONGEST_FILE else []
    for node in ast.walk(tree_of(path)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            length = (node.end_lineno or node.lineno) - node.lineno + 1
            found += [f"{node.name}: {length} lines"] if length > LONGEST_FUNCTION else []
    return ", ".join(found)


def test_all_is_complete_and_importable() -> None:
    assert len(PACKAGES) > 50
    assert not_so(wrong_in_package, PACKAGES) == {}


def test_modules_say_what_they_are_and_what_they_show() -> None:
    assert len(SOURCES) > 500
    assert not_so(wrong_in_module, SOURCES) == {}


def test_files_and_functions_stay_small() -> None:
    by_hand = [path for path in (*SOURCES, *TESTS) if not path.name.startswith("written_")]  # those are recorded
    assert not_so(too_large, by_hand) == {}


def test_the_checks_see_what_is_wrong(tmp_path: Path) -> None:
    """Each of them, on a file that is as it must not be."""
    bad = tmp_path / "bad.py"
    bad.write_text("x = 1\n" * (LONGEST_FILE + 1) + "def long():\n" + "    pass\n" * (LONGEST_FUNCTION + 1))
    assert wrong_in_module(bad) == "a module begins with what it is"
    assert "long: 62 lines" in too_large(bad)
    assert f"{LONGEST_FILE + LONGEST_FUNCTION + 3} lines" in too_large(bad)
    assert list(not_so(too_large, [bad])) == [str(bad)]


def test_no_file_knows_this_machine_or_a_package_index() -> None:
    banned = ["/work/" + "main", "/root" + "/", "pypi" + ".org", "index" + "-url", "find" + "-links"]
    for pattern in ("*.py", "*.toml", "*.md", "*.txt", "Makefile", "*.yml"):
        for path in ROOT.rglob(pattern):
            parts = path.relative_to(ROOT).parts
            if any(part.startswith(".") and part != ".ci" for part in parts) or parts[0] in ("runs", "build", "dist"):
                continue
            text = path.read_text(encoding="utf-8", errors="replace")
            assert not [word for word in banned if word in text], path
