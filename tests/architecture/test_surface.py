"""What packages show, and how large their parts may grow."""

from __future__ import annotations

import ast
import importlib
import json
import pkgutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import safedpa
import safedpa_lab
import safedpa_services
import safedpa_sim

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(path for folder in ("shared", "services", "sim") for path in (ROOT / folder).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
LONGEST_FUNCTION = 60

PACKAGES = sorted(
    info.name
    for package in (safedpa, safedpa_services, safedpa_sim, safedpa_lab)
    for info in pkgutil.walk_packages(package.__path__, package.__name__ + ".")
    if info.ispkg
)


@dataclass(frozen=True)
class Facts:
    """What is looked at of a file; its syntax tree, a hundred times as large, is not kept."""

    reported: bool
    """Whether it begins with a docstring."""
    names: frozenset[str]
    """That it assigns."""
    defined: frozenset[str]
    """Its functions and classes."""
    brought_in: frozenset[str]
    lines: int
    functions: tuple[tuple[str, int], ...]
    """Each with its lines."""


@cache
def facts_of(path: Path) -> Facts:
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    assigned = (target for node in tree.body if isinstance(node, ast.Assign) for target in node.targets)
    imported = (node for node in tree.body if isinstance(node, ast.ImportFrom) and node.module != "__future__")
    functions = (node for node in ast.walk(tree) if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)))
    return Facts(
        reported=bool(ast.get_docstring(tree)),
        names=frozenset(target.id for target in assigned if isinstance(target, ast.Name)),
        defined=frozenset(node.name for node in tree.body if isinstance(node, (ast.ClassDef, ast.FunctionDef))),
        brought_in=frozenset(alias.asname or alias.name for node in imported for alias in node.names),
        lines=text.count("\n"),
        functions=tuple((node.name, (node.end_lineno or node.lineno) - node.lineno + 1) for node in functions),
    )


@cache
def shown_by_modules() -> dict[str, list[str]]:
    """``__all__`` of every module that has one, imported in a process that then ends: together they take 600 MB."""
    names = [".".join(path.with_suffix("").relative_to(ROOT).parts[1:]) for path in SOURCES if has_all(path)]
    code = "import importlib, json, sys\nprint(json.dumps({n: list(importlib.import_module(n).__all__) for n in "
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code + "json.load(sys.stdin)}))"],
        input=json.dumps(names), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    found: dict[str, list[str]] = json.loads(done.stdout.splitlines()[-1])
    return found


def has_all(path: Path) -> bool:
    return "__all__" in facts_of(path).names and path.name not in ("__init__.py", "__main__.py")


def not_so(check: Callable[[Any], str], items: Iterable[Any]) -> dict[str, str]:
    """What is wrong with each item, of those with which something is; one test with a list of all costs a second."""
    return {str(item): wrong for item in items if (wrong := check(item))}


def wrong_in_package(name: str) -> str:
    package = importlib.import_module(name)
    assert package.__file__ is not None
    every = facts_of(Path(package.__file__)).brought_in
    shown = list(getattr(package, "__all__", []))
    if missing := [public for public in shown if not hasattr(package, public)]:
        return f"shows what is not there: {missing}"
    brought_in = {public for public in every if not public.startswith("_")} - {"TYPE_CHECKING", "Any"}
    if name.startswith("safedpa.") and not brought_in <= set(shown):  # of programs it is their own affair
        return f"not in __all__: {brought_in - set(shown)}"
    return "" if len(set(shown)) == len(shown) else "something is twice in __all__"


def wrong_in_module(path: Path) -> str:
    facts = facts_of(path)
    if not facts.reported:
        return "a module begins with what it is"
    if not has_all(path):
        return ""
    shown = shown_by_modules()[".".join(path.with_suffix("").relative_to(ROOT).parts[1:])]
    hidden = {name for name in facts.defined if not name.startswith("_")} - {*shown}
    return f"public, but not in __all__: {hidden}" if hidden else ""


def too_large(path: Path) -> str:
    facts = facts_of(path)
    return ", ".join(f"{name}: {lines} lines" for name, lines in facts.functions if lines > LONGEST_FUNCTION)


def test_all_is_complete_and_importable() -> None:
    assert len(PACKAGES) > 50
    assert not_so(wrong_in_package, PACKAGES) == {}


@pytest.mark.long
def test_modules_say_what_they_are_and_what_they_show() -> None:
    assert len(SOURCES) > 500
    assert not_so(wrong_in_module, SOURCES) == {}


@pytest.mark.long
def test_functions_stay_small() -> None:
    by_hand = [path for path in (*SOURCES, *TESTS) if not path.name.startswith("generated_")]
    assert not_so(too_large, by_hand) == {}


def test_the_checks_see_what_is_wrong(tmp_path: Path) -> None:
    """Each of them, on a file that is as it must not be."""
    bad = tmp_path / "bad.py"
    bad.write_text("x = 1\ndef long():\n" + "    pass\n" * (LONGEST_FUNCTION + 1))
    assert wrong_in_module(bad) == "a module begins with what it is"
    assert "long: 62 lines" in too_large(bad)
    assert list(not_so(too_large, [bad])) == [str(bad)]


@pytest.mark.long
def test_no_file_knows_this_machine_or_a_package_index() -> None:
    banned = ["/work/" + "main", "/root" + "/", "pypi" + ".org", "index" + "-url", "find" + "-links"]
    for pattern in ("*.py", "*.toml", "*.md", "*.txt", "Makefile", "*.yml"):
        for path in ROOT.rglob(pattern):
            parts = path.relative_to(ROOT).parts
            if any(part.startswith(".") and part != ".ci" for part in parts) or parts[0] in ("runs", "build", "dist"):
                continue
            text = path.read_text(encoding="utf-8", errors="replace")
            assert not [word for word in banned if word in text], path
