"""Without a library of effects, free numbers are refitted and nothing is added."""

from __future__ import annotations

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
def test_the_effects_of_the_model_stay_and_their_free_numbers_are_fitted(carpet, given):
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
