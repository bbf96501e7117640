"""Rows that start processes: sense to act and the start. What they ask for, without starting any."""

from __future__ import annotations

from typing import Any

import pytest

from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks import latency
from safedpa_lab.benchmarks.results import Effort, Floor, Row
from safedpa_lab.benchmarks.rows import sense_to_act

LOOP = {"p50": 900.0, "p99": 1210.0, "p999": 3000.0, "watchdog_ticks": 2}


def _sense_to_act(monkeypatch: pytest.MonkeyPatch, effort: Effort, watched: Any) -> tuple[Row, list[Any]]:
    asked: list[Any] = []

    def both(seconds: float, rate: float) -> dict[str, Any]:
        asked.append((seconds, rate))
        return {"real_loop_us": LOOP, "bare_chain_us": {"p50": 800.0, "p99": 10.0 * rate + 800.0, "p999": 2000.0}}

    monkeypatch.setattr(sense_to_act, "latency_benchmark", both)
    monkeypatch.setattr(sense_to_act, "real_loop", watched)
    return sense_to_act.measure(effort), asked


def test_the_loop_is_held_beside_the_bare_chain_of_its_run(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[Any] = []

    def watched(seconds: float, rate: float, *, watched: bool) -> dict[str, Any]:
        looked.append((seconds, rate, watched))
        return {**LOOP, "watchdog_ticks": 0}

    row, asked = _sense_to_act(monkeypatch, Effort(full=True), watched)
    assert asked == [(600.0, 20.0), (600.0, 200.0)]
    assert looked == [(120.0, 20.0, True)]
    wanted = [(target.wanted, target.got) for target in row.targets]
    assert wanted == [(1200.0, 1210.0), (0.0, 2.0), (3360.0, 1210.0), (0.0, 2.0), (1200.0, 1210.0), (0.0, 0.0)]
    assert [target.reached for target in row.targets] == [False, False, True, False, False, True]
    assert row.targets[0].floor == Floor("the bare chain", 1000.0)
    assert not row.targets[0].forbidden
    assert [entry.problem for entry in row.ours] == ["20 Hz", "200 Hz", "20 Hz, watched"]
    assert "workbench" in row.ours[-1].note


def test_a_watched_loop_that_does_not_come_up_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def watched(*_: Any, **__: Any) -> dict[str, Any]:
        raise SafedpaError("safedpa up: ran without workbench")

    row, _ = _sense_to_act(monkeypatch, Effort(), watched)
    assert "without workbench" in row.ours[-1].missing
    assert len(row.targets) == 4
    quick, asked = _sense_to_act(monkeypatch, Effort(quick=True), watched)
    assert asked == [(2.0, 20.0)]
    assert len(quick.ours) == 1


def test_who_should_watch_has_to_be_there() -> None:
    names = ("robot", "recorder", "diagnosis", "dashboard", "workbench")
    services = [{"name": name} for name in names]
    latency._check_watched({"services": services})
    with pytest.raises(SafedpaError, match="without dashboard, workbench"):
        latency._check_watched({"services": services[:3]})
