"""The shipped models on real logs: what a comparison reports, and the friction that a diagnosis finds."""

from __future__ import annotations

import time

import numpy as np
import pytest

from safedpa.compare.comparison import compare_model, with_distinct_names
from safedpa.compare.summary import as_json, decisive, state_sentence
from safedpa.diagnosis.diagnose import add_effect, diagnose
from safedpa.dynamics import load_model
from safedpa.records import load_column_map, load_run
from safedpa.report.comparison_page import write_comparison


def _runs(folder, pattern, model, columns):
    paths = sorted(folder.rglob(pattern))
    if not paths:
        pytest.skip(f"no logs {pattern} in {folder}")
    mapping = load_column_map(columns)
    return with_distinct_names([load_run(path, model.system, mapping) for path in paths], paths)


def test_dart_car_fails_at_speed(data, tmp_path):
    model = load_model("dart_car")
    begin = time.process_time()
    runs = _runs(data / "dart_rc_car", "*.csv", model, "dart_car_columns")
    reading = time.process_time() - begin
    comparison = compare_model(model, runs)
    write_comparison(comparison, tmp_path, "dart_car")  # what is used for the first time is imported
    begin = time.process_time()
    comparison = compare_model(model, runs)
    page, _ = write_comparison(comparison, tmp_path, "dart_car")
    assert time.process_time() - begin < 15.0 * reading  # as long as it takes to read the logs, on an idle core
    assert page.stat().st_size < 6e6
    assert len(runs) == 4
    document = as_json(comparison)
    # without friction and back-EMF the speed runs away: worse than assuming that nothing changes
    assert document["per_state"]["speed"] > document["naive"]["no_change"]["per_state"]["speed"]
    assert "predicted worst is speed" in state_sentence(comparison)
    assert decisive(comparison).variable in ("speed", "throttle")
    speed = next(item for item in comparison.factors if item.variable == "speed")
    assert all(item.bias["speed"] > 0 for item in speed.bins if item.low >= 1.0)
    # where nothing but geometry decides, it is better than both
    for name in ("x", "y"):
        assert document["per_state"][name] < document["naive"]["no_change"]["per_state"][name]
        assert document["per_state"][name] < document["naive"]["constant_velocity"]["per_state"][name]


def test_dfki_pendulum_is_pushed_by_hand(data):
    model = load_model("dfki_pendulum")
    runs = _runs(data / "dfki_pendulum", "data_measured.csv", model, "dfki_pendulum_columns")
    comparison = compare_model(model, runs, 0.4)
    errors = {name: item.value for name, item in comparison.horizons[-1].errors.items()}
    assert errors["model"] < 0.5 * min(errors["no_change"], errors["constant_velocity"])
    time_bins = next(item for item in comparison.factors if item.variable == "time").bins
    worst = max((item for item in time_bins if "energy_shaping" in item.run), key=lambda item: item.error)
    assert worst.low <= 16.06 <= worst.high
    assert np.isfinite(comparison.errors).all()


@pytest.mark.long
def test_the_search_finds_coulomb_friction_in_the_pendulum_whatever_horizon_is_asked_for(data, searched_once):
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


@pytest.mark.long
def test_friction_of_the_car_takes_error_off_logs_that_it_was_not_fitted_to(data):
    model = load_model("dart_car")
    paths = sorted((data / "dart_rc_car").rglob("*.csv"))
    columns = load_column_map("dart_car_columns")
    runs = with_distinct_names([load_run(str(path), model.system, columns) for path in paths], paths)
    found = add_effect(model, "viscous_drag", runs)
    assert found.after.value < 0.85 * found.before.value
