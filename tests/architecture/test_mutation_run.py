"""Every module of the filter stands in the mutation run, and the tests that judge it are there."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

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


@pytest.mark.parametrize("module", MODULES)
def test_the_tests_that_judge_it_are_there(module: str) -> None:
    assert [name for name in MODULES[module] if not name.startswith("-")]
    for name in MODULES[module]:
        file, _, test = name.removeprefix("-").partition("::")
        text = (ROOT / "tests" / "safety" / file).resolve().read_text(encoding="utf-8")
        assert f"def {test.partition('[')[0]}" in text
