"""The largest fleet: one for all beside one for each, and what breaks down does not hold."""

from __future__ import annotations

from typing import Any

import pytest

from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks.fleet import FleetTrial
from safedpa_lab.benchmarks.results import Effort
from safedpa_lab.benchmarks.rows import largest_fleet as row


def _fleet(capacity: int, broken: int) -> Any:
    def drive(trial: FleetTrial) -> dict[str, Any]:
        if trial.robots >= broken:
            raise SafedpaError("robots ended with exit code 1")
        late = 0 if trial.robots <= capacity else 50
        used = {"filter": {"mib_end": 10.0}}
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
    monkeypatch.setattr(row, "fleet_benchmark", _fleet(0, 1))
    assert not row._apart(FleetTrial(3, 1.0))["holds"]
