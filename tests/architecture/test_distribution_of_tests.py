"""Which process of several runs which file of tests: what loads torch goes to one of them, as long as it has any."""

import re
import runpy
from collections import OrderedDict
from pathlib import Path
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
