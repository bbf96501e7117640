"""A model whose action is a throttle, driven: the whole loop, in real processes, by the command that a person types."""

from __future__ import annotations

import io
import json
import shlex
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.records import load_column_map, load_run
from safedpa_services.command_line import safedpa
from safedpa_services.driving import drive_command
from safedpa_services.workbench import jobs
from safedpa_services.workbench.session_files import saved

pytestmark = [pytest.mark.processes, pytest.mark.slow]

SECONDS = "20"
"""Of each drive: two goals and more, and two drives hold what hides in the motor."""
UNFILTERED_SECONDS = "10"
"""It runs into an obstacle before the first goal."""


def quiet(_share: float) -> None:
    """Progress that nobody looks at."""


def run(words: list[str]) -> dict[str, Any]:
    """The command, in this process, which has imported what it needs; what it starts are processes all the same."""
    said = io.StringIO()
    with redirect_stdout(said):
        assert safedpa.run(words) == 0
    return json.loads(said.getvalue())


def up(folder: Path, *options: str) -> dict[str, Any]:
    return run(["up", "--headless", "--json", "--lockstep", "--out", str(folder), *options])


@pytest.fixture(scope="module")
def driven_once(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The first drive: it is repeated, and diagnosed together with others."""
    return up(tmp_path_factory.mktemp("once"), "--model", "dart_car", "--seconds", SECONDS, "--seed", "3")


@pytest.mark.long
def test_it_drives_is_safe_and_repeats_bit_for_bit(driven_once: dict[str, Any], tmp_path: Path) -> None:
    first = driven_once
    second = up(tmp_path, "--model", "dart_car", "--seconds", SECONDS, "--seed", "3")
    assert first["trajectory_sha256"] == second["trajectory_sha256"]
    assert first["ticks"] == 20 * int(SECONDS)
    assert first["goals_reached"] >= 2
    assert first["collisions"] == 0
    assert set(first["verdicts"]) <= {"passed", "corrected", "relaxed"}
    assert all(service["restarts"] == 0 for service in first["services"])
    unfiltered = up(tmp_path, "--model", "dart_car", "--seconds", UNFILTERED_SECONDS, "--seed", "3", "--no-filter")
    assert unfiltered["collisions"] > 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--load", "chair"), "--load: got 'chair' for a car with throttle, steer, whose stand-in has none"),
        (("--change", "hitch"), "--change: got 'hitch' for a car with throttle, steer, whose stand-in has none"),
        (("--settings", "car"), "--settings car: settings: got bounds of -0.6 to 2 1 for throttle"),
        (("--controller", "planner"), "controller 'planner' of a car"),
        (("--robot", "pendulum"), "wanted a pendulum with torque"),
    ],
)
def test_what_it_cannot_is_refused_before_anything_starts(
    options: tuple[str, ...], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert safedpa.run(["up", "--model", "dart_car", "--headless", "--out", str(tmp_path), *options]) == 2
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_what_hides_in_the_motor_is_diagnosed_from_its_drives(driven_once: dict[str, Any], tmp_path: Path) -> None:
    """Dead zone, back-EMF, friction and a bent steering curve: the plain model has none of them, the stand-in has."""
    further = up(tmp_path / "drives", "--model", "dart_car", "--seconds", SECONDS, "--seed", "4")
    recordings = [drive["recording"] for drive in (driven_once, further)]
    report = run(["diagnose", "dart_car", *recordings, "--out", str(tmp_path / "found"), "--json"])
    assert report["verdict"] == "effect_missing"
    assert {"drive_dead_zone", "rolling_resistance", "turning_drag"} & set(report["added"])
    assert report["stages"][-1]["heldout_error"] < 0.5 * report["stages"][0]["heldout_error"]
    model, margin = tmp_path / "found" / "model.toml", tmp_path / "found" / "margin.toml"
    command = shlex.split(drive_command(load_model(str(model)), model, margin))
    driven = run([*command[1:], "--headless", "--json", "--lockstep", "--seconds", SECONDS, "--out", str(tmp_path)])
    assert driven["collisions"] == 0
    assert driven["goals_reached"] >= 2


@pytest.mark.long
def test_the_real_cars_story_is_driven(data_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Logs of the real car, what is missing added as the workbench does, saved; then the command that Save tells.

    It is added by name, so that only the effects that come nearest are tried beside it.
    """
    names = ("turning_drag", "viscous_drag", "rolling_resistance", "drive_dead_zone")
    nearest = [effect("car", name) for name in names]
    monkeypatch.setattr("safedpa.diagnosis.stepwise.library_for", lambda _: nearest)
    logs = sorted((data_folder / "dart_rc_car").glob("91*/*.csv"))[:2]
    if not logs:
        pytest.skip(f"no car logs in {data_folder}")
    given = load_model("dart_car")
    runs = [load_run(path, given.system, load_column_map("dart_car_columns")) for path in logs]
    before = jobs.opened(given, runs, 1.0, quiet)[-1]
    found = jobs.search(before.step, runs, 1.0, quiet)
    version = jobs.taken(before.step, found.proposal, "turning_drag", runs, 1.0, quiet)  # what all four logs name
    assert version.error < 0.8 * before.error
    said = saved(version.step, runs, given, tmp_path / "out", quiet)
    command = shlex.split(said[said.index("safedpa up") :])
    assert command[1:4] == ["up", "--model", str(tmp_path / "out" / "model.toml")]
    driven = run([*command[1:], "--headless", "--json", "--lockstep", "--seconds", SECONDS, "--out", str(tmp_path)])
    assert driven["collisions"] == 0
    assert driven["goals_reached"] >= 2
