"""Shortcuts of the search give the numbers of the slow way: slopes taken over, gains of many, shared models."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.diagnosis.detectable import deviate_of
from safedpa.diagnosis.fit.evidence import evidence_at
from safedpa.diagnosis.fit.least_squares import fit, known_of
from safedpa.diagnosis.fit.trial import deviates_of
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.errors import ModelFileError
from safedpa.records import load_run
from safedpa_lab.hidden import Case, write_case


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
