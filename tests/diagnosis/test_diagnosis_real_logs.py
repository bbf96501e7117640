"""What real logs lack: friction, in the pendulum and in the car."""

from __future__ import annotations

from safedpa.diagnosis.comparison import with_distinct_names
from safedpa.diagnosis.diagnose import add_effect
from safedpa.dynamics import load_model
from safedpa.records import load_column_map, load_run


def test_coulomb_friction_takes_almost_half_of_the_error_off_the_pendulum(data):
    model = load_model("dfki_pendulum")
    paths = sorted((data / "dfki_pendulum").rglob("data_measured.csv"))
    columns = load_column_map("dfki_pendulum_columns")
    runs = with_distinct_names([load_run(str(path), model.system, columns) for path in paths], paths)
    found = add_effect(model, "coulomb_friction", runs, 0.4)
    assert found.after.value < 0.56 * found.before.value
    friction = found.values["coulomb_friction.torque"]
    assert friction.value > 2.0 * friction.std  # two ways of fitting differ by 0.07 N m, which the deviation tells


def test_friction_of_the_car_takes_error_off_logs_that_it_was_not_fitted_to(data):
    model = load_model("dart_car")
    paths = sorted((data / "dart_rc_car").rglob("*.csv"))
    columns = load_column_map("dart_car_columns")
    runs = with_distinct_names([load_run(str(path), model.system, columns) for path in paths], paths)
    found = add_effect(model, "viscous_drag", runs)
    assert found.after.value < 0.85 * found.before.value
