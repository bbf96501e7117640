"""Fits and their deviations: lost filters, bounds, free numbers that get stuck, and quick ways of a search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given as drawn
from hypothesis import settings
from hypothesis import strategies as st

from safedpa.diagnosis.detectable import deviate_of
from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.document import as_document
from safedpa.diagnosis.fit.evidence import evidence_at
from safedpa.diagnosis.fit.least_squares import Fit, fit, known_of, moved
from safedpa.diagnosis.fit.refinement import Refined
from safedpa.diagnosis.fit.trial import deviates_of
from safedpa.diagnosis.search import final_numbers
from safedpa.diagnosis.search.beginning import begun
from safedpa.diagnosis.search.final_numbers import with_final_numbers
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.errors import ModelFileError
from safedpa.records import load_run
from safedpa.report.diagnosis_story import story_of
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


@pytest.fixture(scope="module")
def shooting(tmp_path_factory):
    case = Case("test", 4, {"rolling_resistance": {"deceleration": 0.3}}, runs=3, seconds=15.0)
    log = write_case(case, tmp_path_factory.mktemp("quick"))
    model = load_model(str(log.model))
    found = evidence_at([load_run(str(path), model.system) for path in log.runs], 1.0).shooting
    return found.around(model), model


def test_gains_of_many_differences_are_those_of_each(shooting):
    random = np.random.default_rng(3)
    many = random.standard_t(2.0, (6, len(shooting[0].windows))) + 0.3
    for local in (False, True):
        each = [deviate_of(one, shooting[0], local=local) for one in many]
        np.testing.assert_array_equal(deviates_of(many, shooting[0], local=local), each)


def test_a_fit_that_begins_with_slopes_of_another_ends_where_one_without_does(shooting):
    windows, model = shooting
    first = fit(model.with_effect(effect("car", "viscous_drag"), {}), ["viscous_drag.coefficient"], windows, np.ones(4))
    both = first.model.with_effect(effect("car", "rolling_resistance"), {"deceleration": Setting(0.1)})
    paths = ["viscous_drag.coefficient", "rolling_resistance.deceleration"]
    known = known_of(first, paths)
    assert known.shape[-1] == 1
    slow = fit(both, paths, windows, first.scale)
    quick = fit(both, paths, windows, first.scale, known=known, enough=slow.value + 1.0)
    np.testing.assert_allclose(quick.values, slow.values, atol=0.02 * slow.deviations(windows).max())
    assert slow.values[1] == pytest.approx(0.3, abs=0.02)
    hopeless = fit(both, paths, windows, first.scale, known=known, enough=-np.inf)
    assert hopeless.value >= quick.value


def test_slopes_are_differences_of_residuals(shooting):
    windows, model = shooting
    with_drag = model.with_effect(effect("car", "viscous_drag"), {"coefficient": Setting(0.1)})
    more = with_drag.with_settings({"viscous_drag.coefficient": Setting(0.11)})
    slopes = np.empty((*windows.measured.shape, 1))
    residual = windows.linearised([with_drag, more], [0.01], slopes)
    each = windows.residuals([with_drag, more])
    np.testing.assert_array_equal(residual, each[0])
    counts = windows.counts > 0
    np.testing.assert_allclose(slopes[..., 0][counts], ((each[1] - each[0]) / 0.01)[counts], atol=1e-9)


def test_a_model_with_other_numbers_is_what_the_constructor_makes():
    given = load_model("car").with_effect(effect("car", "viscous_drag"), {"coefficient": Setting(0.1, free=True)})
    settings = {"viscous_drag.coefficient": Setting(0.2), "base.wheelbase": Setting(0.3, free=True)}
    found = given.with_settings(settings)
    wanted = PhysicsModel(given.base, given.effects, {**given.settings, **settings}, given.period, given.holds)
    assert (found.settings, found.latent_names) == (wanted.settings, wanted.latent_names)
    assert found.clock is not given.clock
    state, action = np.array([0.0, 0.0, 0.3, 1.0]), np.array([1.5, 0.1])
    np.testing.assert_array_equal(found.advance(state, action, ())[0], wanted.advance(state, action, ())[0])
    for path, value in (("viscous_drag.coefficient", -9.0), ("viscous_drag.size", 0.1)):
        with pytest.raises(ModelFileError, match=path):
            given.with_settings({path: Setting(value)})


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
