"""The deviation that a number is stated with: from blocks and runs, one-sided at bounds, and never too large."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given as drawn
from hypothesis import settings
from hypothesis import strategies as st

from safedpa.diagnosis.fit.evidence import evidence_at
from safedpa.diagnosis.fit.least_squares import Fit, fit, moved
from safedpa.diagnosis.fit.refinement import Refined
from safedpa.diagnosis.search import final_numbers
from safedpa.diagnosis.search.final_numbers import with_final_numbers
from safedpa.dynamics import Setting, load_model
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
    item = effect("car", name)
    model = model.with_effect(item, {key: Setting(value) for key, value in values.items()})
    evidence = evidence_at(runs, 1.0)
    shooting = evidence.shooting.around(model)
    found = fit(model, [f"{name}.{key}" for key in values], shooting, np.full(4, 0.01))
    return found, shooting, evidence.heldout


def lost(found, values):
    """A filter that ended elsewhere."""
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


def at_a_bound(columns, residual):
    """The deviation of a drag of 0, by slopes and residuals in units of the noise (windows,)."""
    model = load_model("car").with_effect(effect("car", "viscous_drag"), {"coefficient": Setting(0.0)})
    slopes, left = np.array(columns)[:, None, None], np.array(residual)[:, None]
    nothing = (np.zeros((1, 1)), np.zeros(1))
    paths, free = ("viscous_drag.coefficient",), np.array([False])
    found = Fit(model, paths, 0.0, np.ones(1), left, slopes, slopes[..., None, :], free, nothing)
    return float(found.deviations(None)[0])


@pytest.mark.parametrize(
    ("columns", "residual", "wanted"),
    [
        ([4.0], [3.0], (160**0.5 - 12.0) / 16.0),  # 2 x 12 d + 16 d^2 = 1
        ([3.0, 4.0], [4.0, -3.0], 1.0 / 5.0),  # without a slope it is that of a line
        ([0.0], [3.0], np.nan),  # the data say nothing
    ],
)
def test_at_a_bound_the_deviation_is_one_sided(columns, residual, wanted):
    assert at_a_bound(columns, residual) == pytest.approx(wanted, nan_ok=True)


@settings(max_examples=30, deadline=None)
@drawn(st.integers(0, 10_000))
def test_over_the_deviation_at_a_bound_the_squares_grow_by_one(seed):
    random = np.random.default_rng(seed)
    columns, residual = random.normal(0.0, 5.0, 40), random.normal(0.0, 2.0, 40)
    far = at_a_bound(columns, residual)
    away = np.sign(columns @ residual) * columns  # into the side on which the squares grow
    assert ((residual + far * away) ** 2).sum() - (residual**2).sum() == pytest.approx(1.0)


def test_the_steeper_the_squares_rise_the_smaller_the_deviation_at_a_bound():
    found = [at_a_bound([4.0, 1.0], [slope, 0.0]) for slope in (0.0, 0.5, 2.0, 8.0)]
    assert found == sorted(found, reverse=True)
    assert found[-1] < 0.1 * found[0]


def test_runs_that_differ_make_the_deviation_larger(given):
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
def test_an_effect_with_a_corner_has_the_deviation_of_the_windows_where_that_is_larger(
    given, name, values, monkeypatch
):
    """The filter follows slopes, which say nothing of a corner; of a smooth effect its deviation stands."""
    found, shooting, heldout = fitted(given, name, **values)
    certain = Refined(found.model, found.paths, np.full(1, 1e-9), None)
    monkeypatch.setattr(final_numbers, "refined", lambda *_: certain)
    stated = with_final_numbers(found, shooting, heldout)[0].deviations(shooting)
    wanted = found.deviations(shooting) if name == "steering_saturation" else [1e-9]
    np.testing.assert_allclose(stated, wanted)
