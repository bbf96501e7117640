"""The row of all weights: what it trains, and how; no training is started."""

from __future__ import annotations

import subprocess
from typing import Any

import pytest

from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks.results import Effort
from safedpa_lab.benchmarks.rows import weights
from safedpa_sim.training.configuration import load_configuration

Commands = list[tuple[list[str], dict[str, str]]]


def _answering(monkeypatch: pytest.MonkeyPatch, code: int) -> Commands:
    asked: Commands = []

    def run(command: list[str], **settings: Any) -> subprocess.CompletedProcess[str]:
        asked.append((command, settings["env"]))
        return subprocess.CompletedProcess(command, code, "{}", "no disk left\n")

    monkeypatch.setattr(weights.subprocess, "run", run)
    return asked


@pytest.mark.parametrize("effort", [Effort(quick=True), Effort(full=True)])
def test_every_robot_that_ships_weights_is_trained_whole_on_one_thread(
    effort: Effort, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = _answering(monkeypatch, 0)
    row = weights.measure(effort)
    robots = [command[command.index("train") + 1] for command, _ in asked]
    assert sorted(robots) == ["car", "pendulum", "point"]
    assert all(load_configuration(robot) for robot in robots)
    assert all(environment["OMP_NUM_THREADS"] == "1" for _, environment in asked)
    assert all("--phases" not in command for command, _ in asked)
    assert [("--small" in command) for command, _ in asked] == [effort.quick] * 3
    assert [target.wanted for target in row.targets] == ([] if effort.quick else [60.0])
    assert row.ours[0].figures["minutes"] >= max(entry.figures["minutes"] for entry in row.ours[1:])
    assert len({command[command.index("--out") + 1] for command, _ in asked}) == 3


def test_a_failing_training_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    _answering(monkeypatch, 1)
    with pytest.raises(SafedpaError, match=r"train car: no disk left$"):
        weights.measure(Effort(full=True))
