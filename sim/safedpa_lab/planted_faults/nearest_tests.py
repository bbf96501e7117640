"""Which tests stand near a module: by imports, by the folder's name, and by the words that they share.

What imports the module directly stands a step nearer than what imports one that does; so does what lies in a folder of
tests named as one of the module's; a step nearer still what names the class and the function that the fault is in.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

_FOLDERS = ("shared", "services", "sim")
_ELSEWHERE = ("tests/fleet/", "tests/docs/", "tests/architecture/")
"""What needs containers, and what looks at texts: it would notice a docstring, and no fault."""
_FAR = 100
"""Steps: no way of imports leads there, or only a name in a table, as commands are found by."""


class Nearness:
    """Of the tests of a working tree to its modules.

    :param root: of the tree.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    @cached_property
    def _modules(self) -> dict[str, Path]:
        """Each module's file, by the name under which it is imported."""
        found = {}
        for folder in _FOLDERS:
            for path in sorted((self._root / folder).rglob("*.py")):
                parts = path.relative_to(self._root / folder).with_suffix("").parts
                found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
        return found

    @cached_property
    def _given_by(self) -> dict[str, dict[str, tuple[str, str]]]:
        """Of each package the names that it hands on, each with the module that it takes them from, and as what."""
        found: dict[str, dict[str, tuple[str, str]]] = {}
        for name, path in self._modules.items():
            if path.name == "__init__.py":
                found[name] = {
                    alias.asname or alias.name: (node.module or "", alias.name)
                    for node in ast.parse(path.read_text(encoding="utf-8")).body
                    if isinstance(node, ast.ImportFrom)
                    for alias in node.names
                }
        return found

    def _home(self, module: str, name: str) -> str:
        """The module in which a name that is imported from another stands."""
        if f"{module}.{name}" in self._modules:
            return f"{module}.{name}"
        source, original = self._given_by.get(module, {}).get(name, ("", ""))
        return self._home(source, original) if source and source != module else module

    def _imported(self, path: Path) -> Iterator[str]:
        """The modules from which a file takes something, wherever in it that is written."""
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and node.module:
                yield from (self._home(node.module, alias.name) for alias in node.names)
            elif isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in self._modules:
                yield node.value  # of a process that is started, of a method that is replaced

    @cached_property
    def _of_modules(self) -> dict[str, set[str]]:
        return {name: set(self._imported(path)) & set(self._modules) for name, path in self._modules.items()}

    @cached_property
    def _of_tests(self) -> dict[Path, tuple[set[str], set[str]]]:
        """Of each file of tests the modules that it takes from, its folder's fixtures' included, and its words."""
        fixtures = {
            path.parent: set(self._imported(path)) for path in sorted((self._root / "tests").rglob("conftest.py"))
        }
        found = {}
        for path in sorted((self._root / "tests").rglob("test_*.py")):
            if not str(path.relative_to(self._root)).startswith(_ELSEWHERE):
                phrase = set(re.findall(r"\w+", path.read_text(encoding="utf-8")))
                shared = fixtures.get(path.parent, set()) if path.parent.name != "tests" else set[str]()
                found[path] = (set(self._imported(path)) | shared, phrase)
        return found

    def files(self, path: str, function: str, most: int) -> list[str]:
        """The nearest files of tests, nearest first.

        :param path: of the module's file, from the root.
        :param function: qualified name of what the fault is in.
        :param most: so many at most.
        """
        target = next(name for name, file in self._modules.items() if file == self._root / path)
        around = {target: 0}
        new = {target}
        while new:
            new = {name for name, taken in self._of_modules.items() if name not in around and taken & new}
            around |= dict.fromkeys(new, 1 + max(around.values()))
        own = {part for part in function.split(".") if len(part) > 3} | {target.rpartition(".")[2]}
        rated = []
        for file, (taken, phrase) in self._of_tests.items():
            distance = min((around[name] for name in taken if name in around), default=_FAR)
            alike = file.parent.name in Path(path).parts
            if distance < _FAR or alike or own & phrase:
                far = 2 * distance - 2 * alike - min(len(own & phrase), 2)
                rated.append((far, file.stat().st_size, str(file.relative_to(self._root))))
        return [name for *_, name in sorted(rated)][:most]
