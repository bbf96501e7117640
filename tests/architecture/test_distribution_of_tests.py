"""Which process of several runs which file of tests, and which files are not imported where no test of them runs."""

import re
import runpy
from collections import OrderedDict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

TESTS = Path(__file__).parents[1]
CONFTEST = runpy.run_path(str(TESTS / "conftest.py"))
LOADS = re.compile(r"^\s*(import torch|from torch|from stable_baselines3|import stable_baselines3)\b", re.MULTILINE)


def test_what_loads_torch_is_known() -> None:
    loading = {
        f"tests/{path.relative_to(TESTS)}"
        for path in TESTS.rglob("test_*.py")
        if LOADS.search(path.read_text(encoding="utf-8"))
    }
    assert len(loading) > 10
    assert {file for file in loading if CONFTEST["kind_of"](file) != "training"} == set()
    for name in (*CONFTEST["TRAINING"], *CONFTEST["LIGHT"]):
        assert (TESTS / name).exists(), name
    assert CONFTEST["kind_of"]("tests/trainings/test_x.py") == ""
    assert CONFTEST["kind_of"]("tests/bus/test_codec.py") == "light"


class Process:
    """Of xdist: keeps what it is given to run."""

    def __init__(self) -> None:
        self.reported: list[int] = []

    def send_runtest_some(self, indices: list[int]) -> None:
        self.reported += indices


def test_one_process_has_the_trainings_and_the_others_take_them_last(pytestconfig: pytest.Config) -> None:
    files = ["tests/bus/test_a.py", "tests/records/test_b.py", "tests/training/test_c.py", "tests/ros/test_d.py"]
    items = [f"{file}::test" for file in files]

    class Config:
        option = pytestconfig.option

        @staticmethod
        def getvalue(name: str) -> Any:
            return {"dist": "loadfile", "tx": ["popen"] * 2}[name]

    scheduler = CONFTEST["pytest_xdist_make_scheduler"](Config, None)
    first, second = Process(), Process()
    for process in (first, second):
        scheduler.assigned_work[process], scheduler.registered_collections[process] = {}, items
    scheduler.workqueue = OrderedDict((file, {item: False}) for file, item in zip(files, items, strict=True))
    for process in (first, second, first, second):
        scheduler._assign_work_unit(process)
    assert [files[index] for index in first.reported] == ["tests/training/test_c.py", "tests/bus/test_a.py"]
    assert [files[index] for index in second.reported] == ["tests/records/test_b.py", "tests/ros/test_d.py"]
    scheduler.workqueue = OrderedDict([("tests/training/test_c.py", {items[2]: False})])
    scheduler._assign_work_unit(second)
    assert files[second.reported[-1]] == "tests/training/test_c.py", "before it has nothing to do"


def test_of_three_processes_one_has_the_files_that_wait(pytestconfig: pytest.Config) -> None:
    waiting, quick = "tests/hostile/test_secrets.py", ["tests/records/test_b.py", "tests/records/test_c.py"]
    files = [*quick, waiting, "tests/training/test_c.py", "tests/bus/test_a.py"]

    class Config:
        option = pytestconfig.option

        @staticmethod
        def getvalue(name: str) -> Any:
            return {"dist": "loadfile", "tx": ["popen"] * 3}[name]

    scheduler = CONFTEST["pytest_xdist_make_scheduler"](Config, None)
    processes = [Process() for _ in range(3)]
    for process in processes:
        scheduler.assigned_work[process], scheduler.registered_collections[process] = {}, files
    scheduler.workqueue = OrderedDict((file, {file: False}) for file in files)
    for process in (*processes, processes[1], processes[2]):
        scheduler._assign_work_unit(process)
    reported = [[files[index] for index in process.reported] for process in processes]
    assert reported == [["tests/training/test_c.py"], quick, [waiting, "tests/bus/test_a.py"]]


@pytest.mark.parametrize(
    ("asked", "text", "ignored"),
    [
        ("long", "def test_a(): ...", True), ("long", "@pytest.mark.long\ndef test_a(): ...", None),
        ("long", "pytest.param(1, marks=pytest.mark.long)", None), ("not long", "def test_a(): ...", None),
        ("not long", "pytestmark = [pytest.mark.long, pytest.mark.slow]", True),
        ("not long", "@pytest.mark.long\ndef test_a(): ...", None),
        ("", "def test_a(): ...", None), ("processes", "pytestmark = pytest.mark.long", None),
    ],
)  # fmt: skip
def test_a_file_is_not_imported_if_none_of_its_tests_is_asked_for(asked, text, ignored, tmp_path: Path) -> None:
    file = tmp_path / "test_x.py"
    file.write_text(text)
    config = SimpleNamespace(option=SimpleNamespace(markexpr=asked))
    assert CONFTEST["pytest_ignore_collect"](file, config) is ignored
    helper = tmp_path / "conftest.py"
    helper.write_text(text)
    assert CONFTEST["pytest_ignore_collect"](helper, config) is None
