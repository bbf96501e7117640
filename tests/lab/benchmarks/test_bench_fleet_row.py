"""The largest fleet: one for all beside one for each, and what breaks down does not hold."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks.fleet import FleetTrial
from safedpa_lab.benchmarks.results import Effort
from safedpa_lab.benchmarks.rows import largest_fleet as row
from safedpa_lab.benchmarks.table import row_lines


def _fleet(capacity: int, broken: int) -> Any:
    def drive(trial: FleetTrial) -> dict[str, Any]:
        if trial.robots >= broken:
            raise SafedpaError("robots ended with exit code 1")
        late = 0 if trial.robots <= capacity else 50
        each = {"mib_begin": 9.0, "mib_end": 10.0 + 0.2 * trial.robots, "us_per_robot_tick": 60.0}
        used = {"robots": each, "stack_1": each, "stack_2": each, "gone": None}
        times = {"p50": 1000, "p99": 2000 + trial.robots}
        counted = {"robot_ticks": 100 * trial.robots, "late_ticks": late}
        return {"robots": trial.robots, **counted, "sense_to_act_us": times, "processes": used, "holds": late == 0}

    return drive


def test_the_search_ends_at_what_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row, "fleet_benchmark", _fleet(230, 390))
    found = row.measure(Effort())
    assert 215 <= found.ours[0].figures["robots"] <= 230
    assert found.targets[0].reached
    assert found.peers[0].figures["robots"] > found.ours[0].figures["robots"]  # one robot alone always holds here
    trials = found.ours[0].more["trials"]
    assert [trial["holds"] for trial in trials[:3]] == [True, True, False]
    assert "exit code 1" in trials[2]["failed"]
    assert list(found.curves[0].x) == sorted(found.curves[0].x)


def test_one_that_breaks_down_takes_all_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The third of four robots with services of their own breaks down."""
    alone = itertools.count(1)

    def drive(trial: FleetTrial) -> dict[str, Any]:
        breaks = trial.robots == 1 and next(alone) == 3
        found: dict[str, Any] = _fleet(1000, 1 if breaks else 2000)(trial)
        return found

    monkeypatch.setattr(row, "fleet_benchmark", drive)
    first = row.measure(Effort()).peers[0].more["trials"][0]
    assert (first["robots"], first["robot_ticks"], first["holds"]) == (4, 300, False)


def test_the_asked_number_drives_for_ten_minutes_in_full(monkeypatch: pytest.MonkeyPatch) -> None:
    driven: list[FleetTrial] = []
    fleet = _fleet(230, 390)
    monkeypatch.setattr(row, "fleet_benchmark", lambda trial: driven.append(trial) or fleet(trial))
    found = row.measure(Effort(full=True))
    assert (driven[-1].robots, driven[-1].seconds, driven[-1].stacks) == (200, 600.0, 2)
    entry = found.ours[1]
    assert entry.figures["late_percent"] == 0.0
    assert entry.figures["p99_ms"] == pytest.approx(2.2)
    assert entry.figures["mib_gained"] == pytest.approx(3 * 41.0)
    told = {target.what.split(" ")[0]: target for target in found.targets}
    assert told["late"].reached
    assert told["p99"].reached
    assert (told["memory"].wanted, told["memory"].reached) == (40.0, False)
    assert (told["processor"].got, told["processor"].wanted, told["processor"].reached) == (60.0, 125.0, True)
    assert len(row_lines(found.as_document() | {"name": "largest-fleet"})[1]) == 3


def test_ten_minutes_that_break_down_are_late_altogether(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row, "fleet_benchmark", _fleet(150, 180))
    found = row.measure(Effort(full=True))
    assert "exit code 1" in found.ours[1].missing
    late = [target for target in found.targets if target.what.startswith("late")]
    assert [(target.got, target.reached) for target in late] == [(100.0, False)]
    assert not any(target.what.startswith(("p99", "memory", "processor")) for target in found.targets)


def test_without_ten_minutes_the_largest_fleet_gives_the_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row, "fleet_benchmark", _fleet(230, 390))
    found = row.measure(Effort())
    assert len(found.ours) == 1
    cost, elsewhere = found.targets[1:]
    assert cost.what.startswith("processor of a stack, of two, a robot-tick")
    assert cost.got == 60.0
    assert 2.0 * cost.wanted * 400 * 20 == pytest.approx(2.0 * 1e6), "what two cores have"
    assert "400 robots simulated elsewhere" in elsewhere.what
    assert (elsewhere.got, elsewhere.wanted, elsewhere.reached) == (0.96, 2.0, True)
