"""Renames private functions of the product, one at a time, and reports which tests break.

    python tests/tools/rename_private.py --seed S [--functions 40]

Each function is drawn by the seed and renamed in a copy of the working tree, within the product alone: every use of
the name, in all its modules. Then the test files that mention or import its module run (all but those marked long), at
most ``--files`` of them. A test that fails with the old name as well does not count. Exit code 1: more than one
function breaks a test outside ``tests/internals``.
"""

import argparse
import ast
import os
import random
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from nearest import Nearest

ROOT = Path(__file__).resolve().parents[2]
PRODUCT = ("shared/safedpa", "services/safedpa_services", "sim/safedpa_sim")
INTERNALS = "tests/internals/"


def private_functions(root: Path) -> Iterator[tuple[str, str]]:
    """Path and name of each private function and method of the product."""
    for folder in PRODUCT:
        for path in sorted((root / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and re.fullmatch(r"_[a-z]\w*", node.name):
                    yield path.relative_to(root).as_posix(), node.name


def renamed(root: Path, name: str) -> dict[Path, str]:
    """The files of the product that use a name, each with its text before the name is changed in them."""
    word, before = re.compile(rf"\b{name}\b"), {}
    for folder in PRODUCT:
        for path in (root / folder).rglob("*.py"):
            text = path.read_text("utf-8")
            if word.search(text):
                before[path] = text
                path.write_text(word.sub(f"{name}_by_another_name", text), "utf-8")
    return before


def copied(root: Path, folder: Path) -> Path:
    """A copy of the files that git tracks, in ``folder``."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, check=True).stdout
    subprocess.run(
        ["cp", "--parents", "-t", str(folder), *listed.decode().strip("\0").split("\0")], cwd=root, check=True
    )
    return folder


def failing(root: Path, tests: list[str]) -> list[str]:
    """Test files, or single tests, that fail or cannot be collected."""
    paths = os.pathsep.join(str(root / folder) for folder in ("shared", "services", "sim"))
    phrase = ["-q", "--tb=no", "-p", "no:cacheprovider", "-m", "not long", "-n", "2", "--dist", "loadfile", *tests]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *phrase],
        cwd=root,
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    found = re.findall(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return sorted(set(found)) or ([] if done.returncode in (0, 5) else [done.stdout[-500:]])


def main() -> int:
    """Draws, renames, runs and prints one line for each function."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--functions", type=int, default=40)
    parser.add_argument("--files", type=int, default=30, help="test files that run for a function, nearest first")
    given = parser.parse_args()
    drawn = random.Random(given.seed).sample(sorted(set(private_functions(ROOT))), given.functions)
    broken = 0
    with tempfile.TemporaryDirectory(prefix="renamed-") as folder:
        root, nearest = copied(ROOT, Path(folder)), Nearest(ROOT)
        for path, name in drawn:
            tests = [test for test, far in nearest.tests([path]).items() if far <= 1][: given.files]
            before = renamed(root, name)
            failed = failing(root, tests) if tests else []
            for file, text in before.items():
                file.write_text(text, "utf-8")
            anyway = failing(root, failed) if failed else []
            outside = [test for test in failed if test not in anyway and not test.startswith(INTERNALS)]
            inside = [test for test in failed if test not in anyway and test.startswith(INTERNALS)]
            broken += bool(outside)
            print(
                f"{path}:{name}: {len(tests)} files; broken: {outside or 'none'}; internals: {len(inside)}", flush=True
            )
    print(f"{broken} of {given.functions} renamed functions break a test outside {INTERNALS}")
    return 1 if broken > 1 else 0


if __name__ == "__main__":
    sys.exit(main())
