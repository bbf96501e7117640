"""A model whose action is a throttle drives: the whole loop, in real processes, by the user's command."""

import shlex

import pytest
from tests.services.drives import drive, run

from safedpa.api.deployment import drive_command
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.records import load_column_map, load_run
from safedpa_services.workbench.session import jobs
from safedpa_services.workbench.session.files import save_model_files

pytestmark = [pytest.mark.long, pytest.mark.processes, pytest.mark.slow]

SECONDS = "20"
"""Of each drive: two goals and more, and two drives hold what hides in the motor."""
UNFILTERED_SECONDS = "10"
"""It runs into an obstacle before the first goal."""


def quiet(_share):
    """Ignores progress."""


@pytest.fixture(scope="module")
def driven_once(tmp_path_factory):
    """The first drive, which is repeated, and diagnosed together with others."""
    return drive(tmp_path_factory.mktemp("once"), "--model", "dart_car", "--seconds", SECONDS, "--seed", "3")


def test_a_car_with_a_throttle_is_safe_and_repeats_bit_for_bit(driven_once, tmp_path):
    first = driven_once
    second = drive(tmp_path, "--model", "dart_car", "--seconds", SECONDS, "--seed", "3")
    assert first["trajectory_sha256"] == second["trajectory_sha256"]
    assert first["ticks"] == 20 * int(SECONDS)
    assert first["goals_reached"] >= 2
    assert first["collisions"] == 0
    assert set(first["verdicts"]) <= {"passed", "corrected", "relaxed"}
    assert all(service["restarts"] == 0 for service in first["services"])
    unfiltered = drive(tmp_path, "--model", "dart_car", "--seconds", UNFILTERED_SECONDS, "--seed", "3", "--no-filter")
    assert unfiltered["collisions"] > 0


def test_hidden_effects_of_the_motor_are_diagnosed_from_its_drives(driven_once, tmp_path):
    """The simulation has a dead zone, back-EMF, friction and a bent steering curve; the plain model has not."""
    further = drive(tmp_path / "drives", "--model", "dart_car", "--seconds", SECONDS, "--seed", "4")
    recordings = [each["recording"] for each in (driven_once, further)]
    report = run("diagnose", "dart_car", *recordings, "--out", str(tmp_path / "found"))
    assert report["verdict"] == "effect_missing"
    assert {"drive_dead_zone", "rolling_resistance", "turning_drag"} & set(report["added"])
    assert report["stages"][-1]["heldout_error"] < 0.5 * report["stages"][0]["heldout_error"]
    model, margin = tmp_path / "found" / "model.toml", tmp_path / "found" / "margin.toml"
    command = shlex.split(drive_command(load_model(str(model)), model, margin))
    driven = drive(tmp_path, *command[2:], "--seconds", SECONDS)
    assert driven["collisions"] == 0
    assert driven["goals_reached"] >= 2


def test_the_real_cars_story_is_driven(data_folder, tmp_path, monkeypatch):
    """Adds the missing effect to a model from logs of the real car, as the workbench does; saves it and drives.

    The effect is added by name, so that only the nearest effects are tried with it.
    """
    names = ("turning_drag", "viscous_drag", "rolling_resistance", "drive_dead_zone")
    nearest = [effect("car", name) for name in names]
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: nearest)
    logs = sorted((data_folder / "dart_rc_car").glob("91*/*.csv"))[:2]
    if not logs:
        pytest.skip(f"no car logs in {data_folder}")
    given = load_model("dart_car")
    runs = [load_run(path, given.system, load_column_map("dart_car_columns")) for path in logs]
    before = jobs.first_versions(given, runs, 1.0, quiet)[-1]
    found = jobs.search(before.step, runs, 1.0, quiet)
    version = jobs.add_candidate(
        before.step, found.proposal, "turning_drag", runs, 1.0, quiet
    )  # the effect of all four logs
    assert version.error < 0.8 * before.error
    notice = save_model_files(version.step, runs, given, tmp_path / "out", quiet)
    command = shlex.split(notice[notice.index("safedpa up") :])
    assert command[1:4] == ["up", "--model", str(tmp_path / "out" / "model.toml")]
    driven = drive(tmp_path, *command[2:], "--seconds", SECONDS)
    assert driven["collisions"] == 0
    assert driven["goals_reached"] >= 2
