"""The deviation that a number is told with: from blocks and runs, one-sided at bounds, and never carried off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safedpa.diagnosis.fit.evidence import evidence_at
from safedpa.diagnosis.fit.least_squares import fit
from safedpa.diagnosis.fit.refinement import Refined
from safedpa.diagnosis.search import final_numbers
from safedpa.diagnosis.search.final_numbers import with_final_numbers
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa_lab.hidden import Case, write_case


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    case = Case("test", 6, {"rolling_resistance": {"deceleration": 0.3}}, runs=4, seconds=15.0)
    log = write_case(case, tmp_path_factory.mktemp("deviations"))
    model = load_model(str(log.model))
    return model, [load_run(str(path), model.system) for path in log.runs]


def fitted(given, name, **values):
    model, runs = given
    from safedpa.dynamics import Setting

    item = effect("car", name)
    model = model.with_effect(item, {key: Setting(value) for key, value in values.items()})
    evidence = evidence_at(runs, 1.0)
    shooting = evidence.shooting.around(model)
    found = fit(model, [f"{name}.{key}" for key in values], shooting, np.full(4, 0.01))
    return found, shooting, evidence.heldout


def lost(found, values):
    """A filter that ended elsewhere."""
    from safedpa.diagnosis.fit.least_squares import moved

    model = moved(found.model, dict(zip(found.paths, values, strict=True)))
    return lambda *_: Refined(model, found.paths, np.full(len(values), 0.1), None)


@pytest.mark.parametrize("away", [1e9, 0.9], ids=["at_its_bound", "far"])
def test_a_lost_filter_does_not_blow_up_a_deviation(away, given, monkeypatch):
    found, shooting, heldout = fitted(given, "rolling_resistance", deceleration=0.3)
    own = found.deviations(shooting)[0]
    assert own < 0.01
    high = found.model.parameters["rolling_resistance.deceleration"].high
    monkeypatch.setattr(final_numbers, "refined", lost(found, [min(away, high)]))
    final, _ = with_final_numbers(found, shooting, heldout)
    assert final.values[0] == found.values[0]
    stated = final.deviations(shooting)[0]
    assert own <= stated < 4.0 * own


def test_at_a_bound_the_deviation_is_one_sided(given):
    """A drag that would have to push stands at 0; the distance that the data still allow is told."""
    found, shooting, _ = fitted(given, "viscous_drag", coefficient=0.0)
    if found.free[0]:  # noise may ask for a little drag: then it is no bound
        found = replace(found, free=np.array([False]))
    spread = found.deviations(shooting)[0]
    assert np.isfinite(spread)
    columns, residual = found.columns[..., 0], found.residual
    grown = ((residual + spread * columns * np.sign((columns * residual).sum())) ** 2).sum() - (residual**2).sum()
    assert grown == pytest.approx(1.0, rel=1e-6)


def test_runs_that_differ_say_so(given):
    """Each run with another truth: blocks within a run agree, runs do not."""
    found, shooting, _ = fitted(given, "rolling_resistance", deceleration=0.3)
    sides = np.where(shooting.windows.run % 2 == 0, 1.0, -1.0)
    shifted = replace(found, residual=found.residual + 0.05 * sides[:, None] * found.columns[..., 0])
    of_runs = shifted.deviations(shooting)[0]
    one_run = replace(shooting, windows=replace(shooting.windows, run=np.zeros_like(shooting.windows.run)))
    assert of_runs > 1.5 * shifted.deviations(one_run)[0]
    assert 0.01 < of_runs < 0.05


@pytest.mark.parametrize(
    ("name", "values"), [("steering_saturation", {"limit": 0.3}), ("viscous_drag", {"coefficient": 0.2})]
)
def test_what_has_a_corner_is_told_with_the_deviation_of_the_windows_where_that_is_larger(
    given, name, values, monkeypatch
):
    """The filter follows slopes, which say nothing of a corner; of a smooth effect its deviation stands."""
    found, shooting, heldout = fitted(given, name, **values)
    certain = Refined(found.model, found.paths, np.full(1, 1e-9), None)
    monkeypatch.setattr(final_numbers, "refined", lambda *_: certain)
    stated = with_final_numbers(found, shooting, heldout)[0].deviations(shooting)
    wanted = found.deviations(shooting) if name == "steering_saturation" else [1e-9]
    np.testing.assert_allclose(stated, wanted)
