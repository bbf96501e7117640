"""The shipped models on real logs: what a comparison reports."""

from __future__ import annotations

import time

import numpy as np
import pytest

from safedpa.compare.comparison import compare_model, with_distinct_names
from safedpa.compare.summary import as_json, decisive, state_sentence
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
