"""Finds the test files nearest to a source file: by imports, nearest first.

The distance of a test file is the number of imports between it and the changed module. A test file that names the
changed file in a string is as near as one that imports it. Imports inside functions and annotations count.
"""

import re
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

import grimp

__all__ = ["Nearest"]

PACKAGES = {"safedpa": "shared", "safedpa_services": "services", "safedpa_sim": "sim", "safedpa_lab": "sim"}
_IMPORT = re.compile(r"^\s*(?:from (safedpa[\w.]*) import (\([^)]*\)|.*)|import (safedpa[\w.]*))", re.MULTILINE)


class Nearest:
    """Distances between the source files and the test files of a working tree.

    :param root: of the working tree.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    @cached_property
    def _graph(self) -> grimp.ImportGraph:
        return grimp.build_graph(*PACKAGES, include_external_packages=False)

    @cached_property
    def _tests(self) -> dict[str, tuple[str, set[str]]]:
        """Each test file's text and the modules that it imports; its folder's conftest counts as its own."""
        fixtures = {path.parent: self._imports(path.read_text("utf-8")) for path in self._files("conftest.py")}
        found = {}
        for path in self._files("test_*.py"):
            text = path.read_text("utf-8")
            shared = fixtures.get(path.parent, set()) if path.parent.name != "tests" else set()
            found[path.relative_to(self._root).as_posix()] = (text, self._imports(text) | shared)
        return found

    def _files(self, pattern: str) -> list[Path]:
        return sorted((self._root / "tests").rglob(pattern))

    def _imports(self, text: str) -> set[str]:
        found = set()
        for package, names, module in _IMPORT.findall(text):
            found.add(package or module)
            found |= {f"{package}.{name}" for name in re.findall(r"\w+", names)} & self._graph.modules
        return found

    def module(self, path: str) -> str:
        """Import name of a source file; empty for any other file."""
        for package, folder in PACKAGES.items():
            if path.startswith(f"{folder}/{package}/") and path.endswith(".py"):
                return path.removeprefix(f"{folder}/").removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        return ""

    def tests(self, paths: Iterable[str]) -> dict[str, int]:
        """Distance of each test file that comes to one of the changed files, nearest first."""
        distances: dict[str, int] = {}
        for path in paths:
            if path in self._tests:
                distances[path] = -1
            elif module := self.module(path):
                around = self._around(module)
                for test, (text, imports) in self._tests.items():
                    far = min((around[name] for name in imports if name in around), default=99)
                    far = min(far, 0 if module in text or path in text else 99)
                    if far < 99:
                        distances[test] = min(far, distances.get(test, 99))
            else:
                named = [test for test, (text, _) in self._tests.items() if Path(path).name in text]
                distances |= {test: min(0, distances.get(test, 0)) for test in named}
        return dict(sorted(distances.items(), key=lambda item: (item[1], item[0])))

    def _around(self, module: str) -> dict[str, int]:
        """Modules that import a module, directly or not, each with the number of imports between them."""
        if module not in self._graph.modules:
            return {}
        around, newest = {module: 0}, {module}
        while newest:
            importers = set().union(*(self._graph.find_modules_that_directly_import(name) for name in newest))
            newest = importers - around.keys()
            around |= dict.fromkeys(newest, max(around.values()) + 1)
        return around
