"""Every module of the filter and what else judges stands in the mutation run, and the tests that judge it are there."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
MODULES: dict[str, tuple[str, ...]] = runpy.run_path(str(ROOT / "deploy" / "mutation" / "registered.py"))["MODULES"]


LABORATORY = "safedpa_lab"
WHOLE = {"bus/security": set[str](), "bus/wire": {"messages", "setup"}}
"""Folders of which every module is registered, without what only says how messages look."""
JUDGES = {
    "records.units", "diagnosis.search.acceptance", "diagnosis.search.judgement", "diagnosis.search.stages",
    "diagnosis.search.second_opinion", "diagnosis.fit.heldout", "diagnosis.fit.readiness", "diagnosis.coverage",
    "diagnosis.fit.evidence", "diagnosis.search.closest", "compare.windows", "compare.where",
    "compare.rollout_error", "compare.bins", "replay.comparison", "replay.gaps",
    f"{LABORATORY}.experiments.statistics", f"{LABORATORY}.experiments.paired",
}  # fmt: skip
"""Modules elsewhere that read units, judge a model, a recording or a method, or decide what is added to a model."""


def file_of(module: str) -> Path:
    if module.startswith(f"{LABORATORY}."):
        return ROOT / "sim" / Path(*module.split(".")).with_suffix(".py")
    name = module if "." in module else f"safety.{module}"
    return ROOT / "shared" / "safedpa" / Path(*name.split(".")).with_suffix(".py")


def modules_in(folder: str) -> set[str]:
    return {path.stem for path in (ROOT / "shared" / "safedpa" / folder).glob("*.py")} - {"__init__"}


def test_every_module_of_the_filter_is_registered() -> None:
    assert modules_in("safety") == {name for name in MODULES if "." not in name}
    assert [name for name in MODULES if not file_of(name).is_file()] == []


def test_what_judges_elsewhere_is_registered() -> None:
    assert JUDGES - set(MODULES) == set()
    for folder, left_out in WHOLE.items():
        assert left_out < modules_in(folder) or not left_out
        own = {f"{folder.replace('/', '.')}.{name}" for name in modules_in(folder) - left_out}
        assert own - set(MODULES) == set()


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
