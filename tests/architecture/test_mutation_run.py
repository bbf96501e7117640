"""Every module of the filter stands in the mutation run, and the tests that judge it are there."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
MODULES: dict[str, tuple[str, ...]] = runpy.run_path(str(ROOT / "deploy" / "mutation" / "registered.py"))["MODULES"]


def test_every_module_of_the_filter_is_registered() -> None:
    there = {path.stem for path in (ROOT / "shared" / "safedpa" / "safety").glob("*.py")} - {"__init__"}
    assert there == {name for name in MODULES if "." not in name}
    for name in MODULES:
        assert (
            (ROOT / "shared" / "safedpa" / Path(*(name if "." in name else f"safety.{name}").split(".")))
            .with_suffix(".py")
            .is_file()
        )


def test_the_tests_that_judge_each_are_there() -> None:
    texts: dict[Path, str] = {}
    missing = []
    for module, names in MODULES.items():
        assert [name for name in names if not name.startswith("-")], module
        for name in names:
            file, _, test = name.removeprefix("-").partition("::")
            path = (ROOT / "tests" / "safety" / file).resolve()
            text = texts.setdefault(path, path.read_text(encoding="utf-8") if path.is_file() else "")
            if f"def {test.partition('[')[0]}" not in text:
                missing.append((module, name))
    assert missing == []
    assert texts


def test_a_module_that_is_not_registered_costs_one_line() -> None:
    words = [sys.executable, str(ROOT / "deploy" / "mutation" / "run.py"), "--report", "serch"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.splitlines()[-1].startswith("run.py: error: serch: wanted a module of registered.py")
