"""Small experiments with hidden effects, and the commands of all experiments."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest

from safedpa.effects import effect
from safedpa_lab.experiments.diagnosis import hidden_effects as experiment
from safedpa_lab.experiments.diagnosis.hidden_effects import run_cases
from safedpa_lab.hidden import Case, cases_of
from safedpa_services.command_line.group import safedpa


def run(*arguments):
    return safedpa.run(["experiment", *map(str, arguments)])


def test_the_safety_experiment_prints_one_document(tmp_path, capsys):
    out = tmp_path / "safety.json"
    assert run("safety", "--seeds", 1, "--seconds", 0.5, "--out", out, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    retained = json.loads(out.read_text())
    assert retained.pop("provenance")["command"] == "safedpa experiment safety --seeds 1 --seconds 0.5"
    assert (found, found["seeds"]) == (retained, [0, 0])
    assert {row["filter_on"]["episodes"] for row in found["rows"]} == {1}


ORDINARY = {case.name.split("-")[1]: case for case in cases_of("ordinary", 24)}


def short(case, runs=4, seconds=20.0):
    return replace(case, runs=runs, seconds=seconds)


@pytest.fixture(scope="module")
def outcomes():
    """A few cases of each kind, in half the time that the experiment drives."""
    chosen = [short(ORDINARY[name]) for name in ("rolling_resistance", "steering_offset", "steering_lag")]
    chosen += [short(cases_of("none", 1)[0]), short(cases_of("none_hard", 1)[0])]
    return run_cases(chosen)


@pytest.mark.slow
@pytest.mark.long
def test_each_hidden_effect_is_named_and_nothing_else(outcomes):
    for outcome in outcomes[:3]:
        assert outcome.added == outcome.hidden, outcome
        assert outcome.error_ratio < 1.1
        assert all(abs(value) < 4.0 for value in outcome.deviations)


@pytest.mark.slow
@pytest.mark.long
def test_nothing_is_named_where_nothing_is_hidden(outcomes):
    for outcome in outcomes[3:]:
        assert outcome.right, outcome


@pytest.mark.slow
@pytest.mark.long
def test_the_command_prints_one_document(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "safedpa_lab.experiments.diagnosis.hidden_effects.cases_of", lambda *_: [short(cases_of("none", 1)[0])]
    )
    out = tmp_path / "found.json"
    arguments = ["--suite", "none", "--cases", "1", "--processes", "1", "--out", str(out)]
    assert safedpa.run(["experiment", "hidden-effects", *arguments, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    retained = json.loads(out.read_text())
    assert retained.pop("provenance")["command"] == "safedpa experiment hidden-effects --cases 1 --suite none"
    assert shown == retained
    assert shown["suites"][0]["right"]["of"] == 1
    assert safedpa.run(["experiment", "hidden-effects", *arguments]) == 0
    assert "none" in capsys.readouterr().out


@pytest.mark.long
def test_the_diagnosed_model_needs_less_margin(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", "steering_offset")])
    out = tmp_path / "found.json"
    arguments = ["--hidden", "steering_offset", "--seeds", "1", "--seconds", "2", "--drives", "4"]
    arguments += ["--drive-seconds", "30", "--processes", "1", "--out", str(out), "--json"]
    assert safedpa.run(["experiment", "safety-pays", *arguments]) == 0
    result = json.loads(capsys.readouterr().out)
    retained = json.loads(out.read_text(encoding="utf-8"))
    assert retained.pop("provenance")["command"].startswith("safedpa experiment safety-pays --hidden steering_offset")
    assert result == retained
    rows = {row["model"]: row for row in result["rows"]}
    assert rows["diagnosed"]["effects"] == ["steering_offset"]
    assert rows["diagnosed"]["epsilon"]["obstacle"] < 0.7 * rows["incomplete"]["epsilon"]["obstacle"]
    assert all(row["episodes"] == 1 for row in result["rows"])


@pytest.fixture
def two_pendulums(monkeypatch):
    """Two pendulums of two short runs each, one with friction, shown at two horizons; three effects are tried."""
    few = [effect("pendulum", name) for name in ("coulomb_friction", "viscous_friction", "tip_mass")]
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: few)
    cases = [
        Case("pendulum", 11, {"coulomb_friction": {"torque": 0.1}}, "pendulum", runs=2, seconds=8.0),
        Case("pendulum", 12, {}, "pendulum", runs=2, seconds=8.0),
    ]
    monkeypatch.setattr(experiment, "cases_of", lambda *_: cases)
    monkeypatch.setattr(experiment, "HORIZONS", (0.2, 1.0))
    monkeypatch.setattr(experiment.hidden_horizons, "__defaults__", (0, (0.2, 1.0), lambda *_: None))


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("two_pendulums")
def test_every_horizon_gives_the_same_verdict(tmp_path, capsys):
    out = tmp_path / "horizons.json"
    asked = ["experiment", "hidden-effects", "--suite", "pendulum", "--horizons", "--out", str(out)]
    assert safedpa.run(asked) == 0
    assert "equal for every horizon in 2 of 2 cases" in capsys.readouterr().out
    retained = json.loads(out.read_text())
    with_friction, without = retained["cases"]
    assert with_friction["notice"][0]["added"] == ["coulomb_friction"]
    assert without["notice"][0]["added"] == []
    errors = [own["error"] for own in with_friction["notice"]]
    assert errors[0] != errors[1]  # other horizons were shown
    assert retained["provenance"]["command"] == "safedpa experiment hidden-effects --suite pendulum --horizons"


@pytest.mark.slow
@pytest.mark.usefixtures("two_pendulums")
def test_a_case_that_differs_is_reported(monkeypatch, capsys):
    reports = {
        horizon: SimpleNamespace(verdict=verdict, added=added, stages=[SimpleNamespace(heldout_error=0.1)])
        for horizon, verdict, added in ((0.2, "effect_missing", ["tip_mass"]), (1.0, "undecided", []))
    }
    monkeypatch.setattr(experiment, "diagnose", lambda _model, _runs, horizon: reports[horizon])
    assert safedpa.run(["experiment", "hidden-effects", "--suite", "pendulum", "--horizons"]) == 0
    reported = capsys.readouterr().out
    assert "in 0 of 2 cases" in reported
    assert "0.2 s effect_missing tip_mass; 1.0 s undecided" in reported
