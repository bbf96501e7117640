"""Which tests a developer waits for: `make test` and `make test-long` run all of them together, each one once."""

import ast
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TESTS = ROOT / "tests"
MARK = "pytest.mark.long"


def whole_is_long(text: str) -> bool:
    """Of a file of tests: it has no test that `make test` runs; a case of a test that alone is long does not count."""
    if MARK not in text:
        return False
    body = ast.parse(text).body
    marks = [node for node in body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "pytestmark"]
    if any(MARK in ast.unparse(mark) for mark in marks):
        return True
    tests = [node for node in body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
    return all(MARK in map(ast.unparse, test.decorator_list) for test in tests)


def test_a_file_is_long_when_every_test_of_it_is() -> None:
    quick, long = "def test_a():\n    pass\n", f"@{MARK}\ndef test_b():\n    pass\n"
    assert not whole_is_long(quick)
    assert not whole_is_long(long + quick)
    assert not whole_is_long(f"@pytest.mark.parametrize('a', [pytest.param(1, marks={MARK})])\n{quick}")
    assert whole_is_long(long)
    assert whole_is_long(f"pytestmark = [{MARK}, pytest.mark.slow]\n{quick}")


def test_each_folder_has_quick_tests_and_each_file_of_the_filter() -> None:
    quick = {file for file in TESTS.rglob("test_*.py") if not whole_is_long(file.read_text(encoding="utf-8"))}
    for file in TESTS.rglob("test_*.py"):
        of = [file] if file.parent.name == "safety" else file.parent.glob("test_*.py")
        assert quick.intersection(of), f"{file.relative_to(ROOT)}: `make test` should run some of it"


def test_the_two_commands_differ_by_the_marker_alone_and_the_integration_runs_both() -> None:
    markers = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["pytest"]["ini_options"]
    assert [marker for marker in markers["markers"] if marker.startswith("long: ")]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    recipes = dict(re.findall(r"^(test|test-long): environment  ##.*\n\t(.*)\n(?!\t)", makefile, re.MULTILINE))
    assert recipes == {"test": '@$(PYTEST) -m "not long"', "test-long": "@$(PYTEST) -m long"}
    assert re.search(r"^check:.* test test-long ", makefile, re.MULTILINE)
    integration = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    parts = re.findall(r"^part .* run_tests (\S+)$", integration, re.MULTILINE)
    assert parts == ["test", "test-long"]
