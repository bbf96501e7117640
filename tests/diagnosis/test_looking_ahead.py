"""Of effects that explain the same, the one with the fewest numbers is added."""

from __future__ import annotations

import pytest

from safedpa.diagnosis.fit.evidence import evidence_at
from safedpa.diagnosis.fit.trial import tried
from safedpa.diagnosis.search.beginning import begun
from safedpa.diagnosis.search.judgement import plainest
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa_lab.hidden import Case, write_case

NAMES = ("towed_load", "rolling_resistance", "viscous_drag")


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    """(search, trials by effect) of a car with a free gain whose dry friction is hidden."""
    case = Case(
        "test", 4, {"rolling_resistance": {"deceleration": 0.6}}, drive="throttle", hard=True, runs=3, seconds=15
    )
    log = write_case(case, tmp_path_factory.mktemp("free_gain"))
    model = load_model(str(log.model))
    evidence = evidence_at([load_run(str(path), model.system) for path in log.runs], 1.0)
    search = begun(model, evidence.shooting, evidence.heldout)
    return search, {name: tried(search.current, [effect("car", name)], search.shooting) for name in NAMES}


def test_of_two_that_explain_the_same_the_one_with_fewer_numbers_is_added(stage):
    """(gain u - m d) / (1 + m) with a free gain is gain u - d."""
    search, trials = stage
    assert plainest(trials["towed_load"], list(trials.values()), search) is trials["rolling_resistance"]


def test_an_effect_that_explains_something_else_stays(stage):
    search, trials = stage
    assert (
        plainest(trials["towed_load"], [trials["towed_load"], trials["viscous_drag"]], search) is trials["towed_load"]
    )
    assert plainest(trials["viscous_drag"], list(trials.values()), search) is trials["viscous_drag"]
