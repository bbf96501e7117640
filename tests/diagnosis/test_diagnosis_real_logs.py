"""What real logs lack: friction, in the pendulum and in the car."""

from __future__ import annotations

import pytest

from safedpa.compare.comparison import with_distinct_names
from safedpa.diagnosis.diagnose import add_effect, diagnose
from safedpa.dynamics import load_model
from safedpa.records import load_column_map, load_run

pytestmark = pytest.mark.long


def test_coulomb_friction_of_the_pendulum_is_found_at_any_horizon(data, searched_once):
    """Of all effects of the library; the horizon that is shown changes neither verdict nor names nor numbers."""
    model = load_model("dfki_pendulum")
    paths = sorted((data / "dfki_pendulum").rglob("data_measured.csv"))
    columns = load_column_map("dfki_pendulum_columns")
    runs = with_distinct_names([load_run(str(path), model.system, columns) for path in paths], paths)
    reports = [diagnose(model, runs, horizon) for horizon in (0.2, 1.0)]
    assert len(searched_once) == 2
    first = reports[0]
    assert first.verdict == "effect_missing"
    assert first.added == ("coulomb_friction",)
    assert first.stages[-1].heldout_error < 0.6 * first.stages[0].heldout_error
    friction = first.parameters["coulomb_friction.torque"]
    assert friction.std is not None
    assert friction.value > 4.0 * friction.std
    assert 0.1 < friction.value < 0.3  # N m
    for other in reports[1:]:
        assert (other.verdict, other.added, other.parameters) == (first.verdict, first.added, first.parameters)


def test_friction_of_the_car_takes_error_off_logs_that_it_was_not_fitted_to(data):
    model = load_model("dart_car")
    paths = sorted((data / "dart_rc_car").rglob("*.csv"))
    columns = load_column_map("dart_car_columns")
    runs = with_distinct_names([load_run(str(path), model.system, columns) for path in paths], paths)
    found = add_effect(model, "viscous_drag", runs)
    assert found.after.value < 0.85 * found.before.value
