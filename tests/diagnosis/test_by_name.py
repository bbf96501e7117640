"""An effect that says what a formula says is named; a function within two of its deviations is not."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.document import as_document
from safedpa.diagnosis.remains.remaining import peak_of
from safedpa.diagnosis.unexplained import Profile
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa.report.diagnosis_story import story_of
from safedpa_lab.hidden import Case, write_case

NEVER = 1e9


@pytest.fixture
def refusing(monkeypatch):
    """Every named effect is refused, as it is where there are too few blocks."""
    for name in ("SURE", "VERY_SURE", "LIKELY"):
        monkeypatch.setattr(f"safedpa.diagnosis.search.judgement.{name}", NEVER)
    monkeypatch.setattr("safedpa.diagnosis.search.search.passing_elsewhere", lambda *_: None)
    names = ("viscous_drag", "understeer")
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", name) for name in names])


def test_a_refused_effect_that_predicts_like_a_formula_is_named(refusing, tmp_path):
    log = write_case(Case("test", 4, {"viscous_drag": {"coefficient": 0.3}}, runs=3, seconds=20.0), tmp_path)
    model = load_model(str(log.model))
    report = diagnose(model, [load_run(str(path), model.system) for path in log.runs])
    assert report.unexplained is None
    assert report.verdict == "undecided"
    nearest = report.closest[0]
    assert nearest.effect == "viscous_drag"
    assert nearest.parameters["viscous_drag.coefficient"].value == pytest.approx(0.3, abs=0.02)
    assert "likely, not proven" in nearest.reason
    assert "viscous_drag" in story_of(as_document(report)).lead


def profile(values, errors, rows):
    knots = tuple(np.linspace(0.0, 1.0, len(values)).tolist())
    return Profile("throttle", "1", "speed", "m/s2", knots, tuple(values), tuple(errors), None, tuple(rows))


def test_no_headline_without_rows_or_below_two_deviations():
    assert peak_of(profile([61.0, 1.0, 0.5], [66.0, 0.1, 0.1], [500, 500, 500])) == 1
    assert peak_of(profile([61.0, 1.0, 0.5], [0.1, 0.1, 0.1], [0, 500, 500])) == 1
    assert peak_of(profile([61.0, 1.0, 0.5], [66.0, 2.0, 2.0], [500, 500, 500])) is None
