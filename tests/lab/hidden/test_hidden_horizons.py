"""One verdict and the same names, whichever horizon the errors are shown at: measured case by case."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest

from safedpa_lab.experiments import hidden_horizons as experiment
from safedpa_lab.hidden import Case
from safedpa_services.command_line.group import safedpa

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Two pendulums of two short runs each, one with friction, shown at two horizons."""
    cases = [
        Case("pendulum", 11, {"coulomb_friction": {"torque": 0.1}}, "pendulum", runs=2, seconds=8.0),
        Case("pendulum", 12, {}, "pendulum", runs=2, seconds=8.0),
    ]
    monkeypatch.setattr(experiment, "cases_of", lambda *_: cases)
    monkeypatch.setattr(experiment, "HORIZONS", (0.2, 1.0))
    monkeypatch.setattr(experiment.hidden_horizons, "__defaults__", (0, (0.2, 1.0), lambda *_: None))


@pytest.mark.long
def test_every_horizon_gives_the_same_verdict(tmp_path, capsys):
    out = tmp_path / "horizons.json"
    asked = ["experiment", "hidden-effects", "--suite", "pendulum", "--horizons", "--out", str(out)]
    assert safedpa.run(asked) == 0
    assert "equal for every horizon in 2 of 2 cases" in capsys.readouterr().out
    kept = json.loads(out.read_text())
    with_friction, without = kept["cases"]
    assert with_friction["said"][0]["added"] == ["coulomb_friction"]
    assert without["said"][0]["added"] == []
    errors = [own["error"] for own in with_friction["said"]]
    assert errors[0] != errors[1]  # other horizons were shown
    assert kept["provenance"]["command"] == "safedpa experiment hidden-effects --suite pendulum --horizons"


def test_a_case_that_differs_is_reported(monkeypatch, capsys):
    reports = {
        horizon: SimpleNamespace(verdict=verdict, added=added, stages=[SimpleNamespace(heldout_error=0.1)])
        for horizon, verdict, added in ((0.2, "effect_missing", ["tip_mass"]), (1.0, "undecided", []))
    }
    monkeypatch.setattr(experiment, "diagnose", lambda _model, _runs, horizon: reports[horizon])
    assert safedpa.run(["experiment", "hidden-effects", "--suite", "pendulum", "--horizons"]) == 0
    told = capsys.readouterr().out
    assert "in 0 of 2 cases" in told
    assert "0.2 s effect_missing tip_mass; 1.0 s undecided" in told


def test_a_page_is_refused(tmp_path, capsys):
    page = str(tmp_path / "page.md")
    assert safedpa.run(["experiment", "hidden-effects", "--horizons", "--suite", "none", "--page", page]) == 2
    assert "--page" in capsys.readouterr().err
