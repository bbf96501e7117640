"""The pendulum's loop as a person starts it, and what compare and diagnose make of its recording."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from safedpa.dynamics import Setting, load_model, save_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa_services.command_line import safedpa, up
from safedpa_services.supervisor.plan import Plan
from safedpa_sim.robots import TASKS

SWING = ("--robot", "pendulum", "--wind", "4", "--wind-direction", "135", "--seed", "1")


def loop(*arguments: str) -> dict[str, Any]:
    """The summary of a loop of real processes."""
    command = [sys.executable, "-m", "safedpa_services", "up", *arguments, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    document: dict[str, Any] = json.loads(done.stdout)
    return document


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    """run(command, ...) -> the document that it prints, of a library of two: the rest takes time."""
    names = ("coulomb_friction", "viscous_friction")
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("pendulum", n) for n in names])

    def printed(*arguments: str) -> dict[str, Any]:
        assert safedpa.run([*arguments, "--json"]) == 0, capfd.readouterr().err
        shown = capfd.readouterr().out
        assert shown.count("\n") == 1
        document: dict[str, Any] = json.loads(shown)
        return document

    return printed


@pytest.mark.long
@pytest.mark.processes
def test_it_is_safe_and_its_recording_compares_and_is_diagnosed(
    tmp_path: Path, run: Callable[..., dict[str, Any]]
) -> None:
    words = (*SWING, "--lockstep", "--headless", "--seconds", "6", "--out", str(tmp_path))
    summary = loop(*words)
    assert summary["ticks"] == 600
    assert summary["collisions"] == 0
    assert summary["task"] == "balance"
    assert set(summary["verdicts"]) == {"corrected", "passed"}
    assert summary["verdicts"]["corrected"] > 100
    recording, report = summary["recording"], tmp_path / "report"
    still = run("compare", "pendulum", recording, "--horizon", "0.2", "--out", str(report))
    told = run("compare", str(_in_the_wind(tmp_path)), recording, "--horizon", "0.2", "--out", str(report))
    assert still["runs"][0]["windows"] == told["runs"][0]["windows"] > 40
    assert told["runs"][0]["error"] < 0.01
    assert still["runs"][0]["error"] > 0.5
    diagnosed = run("diagnose", "pendulum", recording, "--horizon", "0.2", "--out", str(report))
    assert diagnosed["robot"] == "pendulum"
    assert (report / "report.html").stat().st_size > 1000
    unfiltered = loop(*words, "--no-filter")
    assert unfiltered["collisions"] > 0
    assert unfiltered["collision_list"][0]["what"] in ("lower edge", "upper edge")


def _in_the_wind(folder: Path) -> Path:
    model = load_model("pendulum")
    blowing = {"wind.speed": Setting(-(8**0.5)), "wind.upward": Setting(8**0.5)}
    save_model(model.with_settings({**model.settings, **blowing}), folder / "blown.toml")
    return folder / "blown.toml"


def planned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *options: str) -> Plan:
    seen: list[Plan] = []

    def drive(plan: Plan, *_: Any, **__: Any) -> dict[str, Any]:
        seen.append(plan)
        return {}

    monkeypatch.setattr(up, "driven", drive)
    result = CliRunner().invoke(up.command, ["--json", "--headless", "--out", str(tmp_path), *options])
    if result.exception is not None:
        raise result.exception
    return seen[0]


def test_model_settings_and_rate_are_the_robots_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = planned(tmp_path, monkeypatch, *SWING, "--task", "swing")
    assert (plan.model, plan.settings, plan.rate) == ("pendulum", "pendulum", 100.0)
    assert set(plan.surroundings) == {"--task=swing", "--wind=4.0", "--wind-direction=135.0"}
    assert set(plan.surroundings) < set(plan.robot_process().arguments)
    car = planned(tmp_path, monkeypatch)
    assert (car.model, car.settings, car.rate, car.surroundings) == ("car", "car", 20.0, ())
    assert set(up.TASKS) == set(TASKS)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--wind", "4"), "--wind: got one for a car"),
        (("--task", "swing"), "--task: got one for a car"),
        (("--robot", "pendulum", "--load", "box"), "--load: got one for a pendulum"),
        (("--robot", "pendulum", "--change", "hitch"), "--change: got one for a pendulum"),
        (("--robot", "pendulum", "--wind", "-1"), "--wind: got -1.0"),
        (("--robot", "pendulum", "--wind-direction", "999"), "--wind-direction: got 999.0"),
        (("--robot", "pendulum", "--model", "car"), "wanted a pendulum with torque"),
        (("--robot", "pendulum", "--controller", "planner"), "known: learned, random"),
        (("--robot", "pendulum", "--rate", "0"), "--rate"),
    ],
)
def test_what_does_not_fit_is_refused_before_any_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        planned(tmp_path, monkeypatch, *options)
