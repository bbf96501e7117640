"""Where too little is known to judge, free numbers are refitted, and nothing is added whatever is missing."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.diagnosis.fit.heldout import heldout_of
from safedpa.diagnosis.fit.shooting import shooting_of
from safedpa.diagnosis.search.search import searched
from safedpa.dynamics import Setting, load_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa_lab.hidden import Case, write_case


@pytest.fixture(scope="module")
def carpet(tmp_path_factory):
    case = Case(
        "test", 11, {"rolling_resistance": {"deceleration": 0.9, "x_above": 0.4}},
        laws={"rolling_resistance": "where x above"}, runs=2, seconds=15.0,
    )  # fmt: skip
    return write_case(case, tmp_path_factory.mktemp("carpet"))


@pytest.mark.parametrize("given", [0.0, 0.5])
def test_the_models_effects_stay_as_they_are_with_numbers_fitted(carpet, given):
    """A carpet beyond a line: with the library it would be found, and the plain resistance would get a law."""
    model = load_model(carpet.model)
    if given:
        model = model.with_effect(effect("car", "rolling_resistance"), {"deceleration": Setting(given, free=True)})
    runs = [load_run(path, model.system) for path in carpet.runs]
    search = searched(model, [], shooting_of(runs, 1.0), heldout_of(runs, 1.0))
    found = search.current.fit.model
    assert [type(item) for item in found.effects] == [type(item) for item in model.effects]
    assert search.added == []
    assert search.candidates == []
    assert found.settings.keys() == model.settings.keys()
    changed = {name for name, setting in found.settings.items() if setting.value != model.settings[name].value}
    assert changed == {name for name, setting in model.settings.items() if setting.free}
    assert search.error.value <= search.first_error.value


def test_gain_is_told_in_standard_errors_of_the_sum_of_independent_blocks():
    """Of 40 blocks of equal size whose gains are normal: Student's ratio of their mean, worked out otherwise."""
    from safedpa.diagnosis.remains.weak_form import Regression

    random = np.random.default_rng(4)
    block = np.repeat(np.arange(40), 25)
    problem = Regression(np.zeros((1000, 1)), np.zeros((1000, 1, 0)), 0, block % 5, block)
    other = random.uniform(1.0, 2.0, 1000)
    gain = random.normal(0.02, 0.3, 1000)
    sums = gain.reshape(40, 25).sum(axis=1)
    variance = ((sums - sums.mean()) ** 2).sum() / 39
    assert problem.sure(other + gain, other) == pytest.approx(sums.mean() / np.sqrt(variance / 40), rel=1e-9)
    assert problem.sure(other - gain, other) == pytest.approx(-sums.mean() / np.sqrt(variance / 40), rel=1e-9)
    assert problem.sure(100.0 * (other + gain), 100.0 * other) == pytest.approx(problem.sure(other + gain, other))


def test_by_chance_gain_exceeds_two_standard_errors_in_one_case_of_twenty():
    """With nothing to gain: what the search takes for sure is rare, whatever the size of the errors is."""
    from safedpa.diagnosis.remains.weak_form import Regression

    random = np.random.default_rng(11)
    block = np.repeat(np.arange(60), 10)
    problem = Regression(np.zeros((600, 1)), np.zeros((600, 1, 0)), 0, block % 5, block)
    found = np.array([problem.sure(random.normal(0.0, 30.0, 600), np.zeros(600)) for _ in range(2000)])
    assert found.std() == pytest.approx(1.0, abs=0.06)
    assert (np.abs(found) > 2.0).mean() == pytest.approx(0.05, abs=0.012)


def test_fewer_than_eight_blocks_say_nothing():
    from safedpa.diagnosis.remains.weak_form import Regression

    block = np.repeat(np.arange(7), 10)
    problem = Regression(np.zeros((70, 1)), np.zeros((70, 1, 0)), 0, block % 5, block)
    assert problem.sure(np.ones(70), np.zeros(70)) == 0.0
