"""Free numbers of the base do not get stuck, and a base that is worse than no change is reported first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.document import as_document
from safedpa.diagnosis.fit.evidence import evidence_at
from safedpa.diagnosis.search.beginning import begun
from safedpa.dynamics import Setting
from safedpa.effects import effect
from safedpa.report.diagnosis_story import story_of


@pytest.fixture
def runs(plain, drive):
    random = np.random.default_rng(2)
    noise = (0.002, 0.002, 0.003, 0.015)
    clean = [drive(plain, 20.0, seed, name=f"drive_{seed}") for seed in range(3)]
    return [replace(run, states=run.states + random.normal(0.0, noise, run.states.shape)) for run in clean]


@pytest.mark.parametrize("guess", [0.9, 3.1, 20.0])
@pytest.mark.parametrize("wheelbase", [0.1, 0.29, 2.0])
def test_a_bad_guess_ends_where_a_good_one_does(guess, wheelbase, plain, runs):
    model = plain.with_settings({"base.drive_gain": Setting(guess, True), "base.wheelbase": Setting(wheelbase, True)})
    evidence = evidence_at(runs, 1.0)
    found = begun(model, evidence.shooting, evidence.heldout).first.fit
    values = dict(zip(found.paths, found.values.tolist(), strict=True))
    assert values["base.drive_gain"] == pytest.approx(3.0, abs=0.05)
    assert values["base.wheelbase"] == pytest.approx(0.3, abs=0.01)


def test_a_base_that_is_worse_than_no_change_is_reported_first(plain, runs, monkeypatch):
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", "payload")])
    lost = plain.with_settings({"base.wheelbase": Setting(0.05)})
    document = as_document(diagnose(lost, runs))
    assert document["naive"]["no_change"] < document["stages"][0]["heldout_error"]
    assert story_of(document).lead.startswith(
        "The given model, its free numbers refitted, predicts worse than assuming"
    )
    assert not story_of(as_document(diagnose(plain, runs))).lead.startswith("The given model")
