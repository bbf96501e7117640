"""The point robot's loop as a person starts it: goals among hazards in a force that nobody tells it of."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from safedpa_services.command_line import safedpa


@pytest.mark.processes
def test_it_reaches_goals_and_enters_no_hazard(tmp_path: Path) -> None:
    loop = ["up", "--robot", "point", "--force", "0.008", "--wind-direction", "135", "--seed", "3"]
    short = ["--lockstep", "--headless", "--seconds", "6", "--out", str(tmp_path), "--json"]
    command = [sys.executable, "-m", "safedpa_services", *loop, *short]
    done = subprocess.run(command, capture_output=True, text=True, timeout=170, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["ticks"] == 300
    assert summary["collisions"] == summary["watchdog_ticks"] == 0
    assert summary["goals_reached"] >= 1
    assert "fallback" not in summary["verdicts"]


@pytest.mark.parametrize(
    "options", [["--wind", "3"], ["--load", "box"], ["--force", "0.02"], ["--task", "swing"], ["--rate", "0.1"]]
)
def test_what_it_has_not_is_refused(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["up", "--robot", "point", *options]) == 2
    assert options[0] in capsys.readouterr().err


def test_a_force_is_the_point_robots_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["up", "--force", "0.004"]) == 2
    assert "car, which has none" in capsys.readouterr().err
