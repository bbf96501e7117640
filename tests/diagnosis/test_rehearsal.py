"""What recordings could show: checked before a search, and rehearsed with effects hidden in their own commands."""

from __future__ import annotations

import json

import numpy as np
import pytest

from safedpa.diagnosis.check import check_lines, checked
from safedpa.diagnosis.rehearsal import as_driven, measured_noise, rehearsal_of, simulated
from safedpa.dynamics import Setting, load_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.records import load_run
from safedpa.records.run import Run, Stretch
from safedpa_lab.hidden import Case, write_case
from safedpa_lab.hidden.sensor import NOISE
from safedpa_services.command_line.group import safedpa

pytestmark = pytest.mark.slow

LIBRARY = ("rolling_resistance", "understeer", "viscous_drag", "speed_command_gain")


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_case(Case("test", 21, {}, runs=3, seconds=15.0), tmp_path_factory.mktemp("rehearsal"))


@pytest.fixture(autouse=True)
def few(monkeypatch):
    for place in ("diagnose", "check", "rehearsal"):
        found = f"safedpa.diagnosis.{place}.library_for"
        monkeypatch.setattr(found, lambda _: [effect("car", name) for name in LIBRARY])


@pytest.fixture
def given(log):
    model = load_model(log.model)
    return model, [load_run(path, model.system) for path in log.runs]


def test_the_noise_of_the_logs_is_measured(given):
    np.testing.assert_allclose(measured_noise(given[1]), NOISE["car"], rtol=0.25)


def test_noise_is_measured_during_any_steady_motion():
    deviations, random = np.array([0.002, 0.05, 0.3, 1.0]), np.random.default_rng(4)
    t = 0.05 * np.arange(4000.0)
    states = np.array([1.0, -2.0, 0.3, 4.0]) * t[:, None] + random.normal(0.0, deviations, (4000, 4))
    run = Run("steady", load_model("car").system, t, states, np.zeros((4000, 2)), (Stretch(0, 4000),))
    assert measured_noise([run]) == pytest.approx(deviations, rel=0.1)


def test_simulated_logs_have_the_commands_and_the_noise_of_the_given_ones(given):
    model, runs = given
    again = list(simulated(model, runs, measured_noise(runs), np.random.default_rng(0)))
    for one, other in zip(runs, again, strict=True):
        np.testing.assert_array_equal(one.actions, other.actions)
        apart = np.abs(one.system.difference(one.states, other.states))
        assert np.median(apart) < 0.02  # nothing is missing, so the model drives where the robot did
    np.testing.assert_allclose(measured_noise(again), measured_noise(runs), rtol=0.25)


def test_a_guess_of_a_free_number_is_fitted_before_anything_is_driven(tmp_path):
    """The car has a gain of 4.95 or 4.05, in gusts; with three times as much it would drive three times as fast."""
    log = write_case(Case("test", 22, {}, runs=2, seconds=15.0, drive="throttle", hard=True), tmp_path)
    model = load_model(log.model)
    runs = [load_run(path, model.system) for path in log.runs]
    guessed = model.with_settings({"base.drive_gain": Setting(15.0, True)})
    driven = as_driven(guessed, runs)
    assert driven.latent_names == guessed.latent_names
    assert 3.0 < driven.settings["base.drive_gain"].value < 6.0
    again = next(simulated(driven, runs, measured_noise(runs), np.random.default_rng(0)))
    assert np.abs(again.states[:, 3]).max() < 2.0 * np.abs(runs[0].states[:, 3]).max()


def test_the_check_reports_which_effects_show_and_which_only_as_a_sum(given):
    found = checked(*given)
    assert {item.effect for item in found.told()} == {"rolling_resistance", "understeer"}
    assert {item.effect for item in found.as_sums()} == {"viscous_drag", "speed_command_gain"}
    told = "\n".join(check_lines(found))
    assert "only as a sum" in told
    assert "together with viscous_drag" in told


@pytest.mark.long
def test_a_rehearsal_finds_what_the_check_foretells(given):
    found = rehearsal_of(*given, sizes=(0.002, 1.0), names=("rolling_resistance", "understeer"))
    assert [(trial.effect, trial.found) for trial in found.trials] == [
        ("rolling_resistance", False),
        ("rolling_resistance", True),
        ("understeer", False),
        ("understeer", True),
    ]
    assert found.agreeing == 4


@pytest.mark.long
def test_the_commands_print_the_check_and_the_rehearsal(log, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    runs = [str(path) for path in log.runs]
    assert safedpa.run(["diagnose", str(log.model), *runs, "--check"]) == 0
    assert "Would be found, from this size on:" in capsys.readouterr().out
    assert safedpa.run(["diagnose", str(log.model), *runs, "--check", "--json"]) == 0
    assert {item["effect"] for item in json.loads(capsys.readouterr().out)["sizes"]} == set(LIBRARY)
    assert safedpa.run(["rehearse", str(log.model), *runs, "--effect", "understeer"]) == 0
    assert "1 of 1 as the check of these runs foretells" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []  # nothing is written


def test_an_unknown_effect_is_refused(given):
    with pytest.raises(InputError, match="understeer"):
        rehearsal_of(*given, names=("underster",))
