"""What makes the search quick gives the numbers of the slow way: laws by Schur complement, slopes taken over, whitening
entry by entry, models that share their structure."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.diagnosis.detectable import deviate_of
from safedpa.diagnosis.fit.evidence import evidence_at
from safedpa.diagnosis.fit.heldout import heldout_of
from safedpa.diagnosis.fit.innovations import _whitened
from safedpa.diagnosis.fit.least_squares import fit, known_of
from safedpa.diagnosis.fit.shooting import shooting_of
from safedpa.diagnosis.fit.trial import deviates_of, tried
from safedpa.diagnosis.search.beginning import begun
from safedpa.diagnosis.search.condition_screen import Proposal, _Sums
from safedpa.diagnosis.search.conditions import _fitted
from safedpa.diagnosis.search.search import accept
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import Where, effect
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


def by_hand(columns, column, residual, weights, fold):
    """Fall of unseen squares of each window, all numbers fitted without its fold."""
    wide = np.concatenate([columns, (weights[:, None] * column)[..., None]], axis=-1)
    found = np.zeros(len(weights))
    for own in np.unique(fold):
        for sign, used in ((1.0, columns), (-1.0, wide)):
            target = residual[fold != own].reshape(-1)
            values = -np.linalg.lstsq(used[fold != own].reshape(len(target), -1 if used.size else 0), target)[0]
            left = ((residual + used @ values)[fold == own] ** 2).sum(axis=1)
            found[fold == own] += sign * left
    return found


@pytest.mark.parametrize("paths", [0, 1, 5])
def test_laws_are_judged_as_a_fit_of_each_would_be(paths):
    random = np.random.default_rng(paths)
    columns, column, residual = (random.normal(size=(24, 9, *more)) for more in ((paths,), (), ()))
    weights, fold = random.random((3, 24)), np.arange(24) % 4
    null = SimpleNamespace(fit=SimpleNamespace(residual=residual, columns=columns))
    falls, values = _Sums(null, SimpleNamespace(fold=fold)).judged(column, weights)
    assert values.shape == (3, paths + 1)
    for law in range(3):
        wanted = by_hand(columns, column, residual, weights[law], fold)
        np.testing.assert_allclose(falls[law], wanted, rtol=1e-6, atol=1e-6)


def test_whitening_is_that_of_the_cholesky_factor():
    random = np.random.default_rng(2)
    root, right = random.normal(size=(5, 7, 3, 3)), random.normal(size=(5, 7, 3, 4))
    total = root @ root.swapaxes(-1, -2) + np.eye(3)
    found, log = _whitened(total, right)
    np.testing.assert_allclose(found, np.linalg.solve(np.linalg.cholesky(total), right), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(log, np.linalg.slogdet(total)[1], rtol=1e-12, atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError, match="not positive"):
        _whitened(-total, right)


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


@pytest.fixture(scope="module")
def floor(tmp_path_factory):
    """What a search knows that took a carpet beyond a line for a resistance everywhere."""
    carpet = {"rolling_resistance": {"deceleration": 0.9, "x_above": 0.4}}
    case = Case("test", 11, carpet, laws={"rolling_resistance": "where x above"}, runs=2, seconds=15.0)
    log = write_case(case, tmp_path_factory.mktemp("floor"))
    model = load_model(str(log.model))
    runs = [load_run(path, model.system) for path in log.runs]
    heldout = heldout_of(runs, 1.0)
    search = begun(model, shooting_of(runs, 1.0), heldout)
    accept(search, tried(search.current, [effect("car", "rolling_resistance")], search.shooting), heldout)
    return search


@pytest.mark.parametrize("begin", [(0.0, 0.9), (1.0, 0.45), (2.0, 0.1), (2.0, 0.45), (2.0, 0.9)])
def test_a_law_is_not_fitted_with_the_slope_of_the_number_without_it(floor, begin):
    """Everywhere and in one place a deceleration bears the same name; and a fit that still falls fast is not left."""
    start = dict(zip(("x_above", "deceleration"), begin, strict=True))
    item = effect("car", "rolling_resistance")
    found = _fitted(floor, Proposal(item, Where("above", "x", 0.05), start, 0.0, 0.0))
    assert found is not None
    settings = found.fit.model.settings
    assert settings["rolling_resistance.x_above"].value == pytest.approx(0.4, abs=0.1)
    assert settings["rolling_resistance.deceleration"].value == pytest.approx(0.9, abs=0.05)


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
