"""The row of the start, from what its processes are reported to take; ``tests/lab/benchmarks`` measures them."""

import pytest

from safedpa_lab.benchmarks.results import Effort, Floor
from safedpa_lab.benchmarks.rows import start


def test_the_start_has_a_target_of_each_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    def imported(module: str, _: int) -> tuple[float, bool]:
        return 0.3 if "dashboard" in module else 0.2 if "policy" in module else 0.1, False

    monkeypatch.setattr(start, "_started", lambda: (1.9, {"policy": 50.0}))
    monkeypatch.setattr(start, "seconds_to_pages", lambda: {"live view": 4.5, "workbench": 5.0})
    monkeypatch.setattr(start, "_compared", lambda _: 1.5)
    monkeypatch.setattr(start, "_imported", imported)
    row = start.measure(Effort(quick=True))
    got = {target.what: (target.wanted, target.got, target.reached) for target in row.targets}
    assert got["start to the first action"] == (2.0, 1.9, True)
    assert got["start to the live view"] == (4.0, 4.5, False)
    assert got["safedpa compare of a recording"] == (2.0, 1.5, True)
    assert got["import safedpa"] == (0.15, 0.1, True)
    assert row.targets[0].floor == Floor("import of policy", 0.2), "an action needs no dashboard"
    assert row.targets[1].floor == Floor("import of dashboard", 0.3)
    assert {entry.name for entry in row.ours if entry.problem == "start"} >= {"safedpa up to the workbench"}
