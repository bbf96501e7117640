"""Compiled modules define no exception whose base stands in another module: its words would be memory of others."""

import ast
import builtins
from pathlib import Path

import pytest

from safedpa.compiled import MODULES

ROOT = Path(__file__).resolve().parents[2]


def is_builtin_exception(name: str) -> bool:
    found = getattr(builtins, name, None)
    return isinstance(found, type) and issubclass(found, BaseException)


@pytest.mark.parametrize("module", MODULES)
def test_its_exceptions_derive_from_those_of_python_alone(module: str) -> None:
    source = ROOT / ("sim" if module.startswith("safedpa_sim.") else "shared") / module.replace(".", "/")
    tree = ast.parse(source.with_suffix(".py").read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and node.name.endswith("Error"):
            assert all(is_builtin_exception(ast.unparse(base)) for base in node.bases), f"{module}.{node.name}"
