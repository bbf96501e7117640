"""Real logs: what comparisons and diagnoses say of the car, the pendulum and the balls."""

import json
import time
from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.comparison.comparison import compare_model, with_distinct_names
from safedpa.comparison.summary import as_json, most_influential_factor, state_sentence
from safedpa.diagnosis.diagnose import add_effect, diagnose
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.records import load_column_map, load_run
from safedpa.report.comparison_page import write_comparison
from safedpa_lab.experiments.diagnosis.real_logs import targets_of
from safedpa_lab.experiments.diagnosis.real_logs_data import CAR, paths_of, uncovered
from safedpa_services.command_line.group import safedpa


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
    assert most_influential_factor(comparison).variable in ("speed", "throttle")
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
def test_coulomb_friction_of_the_pendulum_is_found_at_any_horizon(data, searched_once):
    """Of all effects of the library; the horizon that is shown changes neither verdict nor names nor numbers."""
    model = load_model("dfki_pendulum")
    runs = _runs(data / "dfki_pendulum", "data_measured.csv", model, "dfki_pendulum_columns")
    reports = [diagnose(model, runs, horizon) for horizon in (0.2, 1.0)]
    assert len(searched_once) == 2
    first = reports[0]
    assert (first.verdict, first.added) == ("effect_missing", ("coulomb_friction",))
    assert first.stages[-1].heldout_error < 0.6 * first.stages[0].heldout_error
    friction = first.parameters["coulomb_friction.torque"]
    assert friction.std is not None
    assert friction.value > 4.0 * friction.std
    assert 0.1 < friction.value < 0.3  # N m
    for other in reports[1:]:
        assert (other.verdict, other.added, other.parameters) == (first.verdict, first.added, first.parameters)


@pytest.mark.long
def test_friction_of_the_car_reduces_the_error_on_unseen_logs(data):
    model = load_model("dart_car")
    found = add_effect(model, "viscous_drag", _runs(data / "dart_rc_car", "*.csv", model, "dart_car_columns"))
    assert found.after.value < 0.85 * found.before.value


COMMAND = ["experiment", "real-logs", "--processes", "1"]


@pytest.mark.long
def test_the_diagnosis_of_the_balls_meets_its_targets(data, tmp_path, capsys):
    out = tmp_path / "balls.json"
    assert safedpa.run([*COMMAND, "--data", str(data), "--part", "balls", "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "Bowling Ball" in shown
    assert "missed" not in shown
    result = json.loads(out.read_text(encoding="utf-8"))
    assert {"experiment", "date", "seed", "versions", "targets", "rows"} <= set(result)
    assert {row["name"] for row in result["rows"] if row["added"]} >= {"Whiffle Ball 1", "Whiffle Ball 2"}
    assert all(item["met"] for item in result["targets"])


@pytest.mark.long
def test_a_log_that_was_left_out_judges_the_fit_of_the_others(data, tmp_path, capsys, monkeypatch):
    names = ("viscous_drag", "turning_drag")
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", name) for name in names])
    for path in paths_of(data, CAR)[:2]:
        (tmp_path / path.name).symlink_to(path)
    assert safedpa.run([*COMMAND, "--data", str(tmp_path), "--part", "car", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [bool(row["name"]) for row in rows] == [False, True, True]
    assert "unseen_change" not in rows[0]
    for row in rows[1:]:
        assert set(row["added"]) <= set(names)
        assert row["unseen_change"] == pytest.approx(row["unseen_after"] / row["unseen_before"] - 1.0, abs=1e-3)
        assert row["added"] or row["unseen_change"] == 0.0
        assert row["unseen_outside"] > 0.5  # one drives slowly, the other fast


def driven(*throttles):
    """A log at 20 Hz that stays for 5 s at each throttle, at a speed of its own."""
    throttle = np.repeat(throttles, 100)
    system = SimpleNamespace(state_names=("x", "speed"), action_names=("throttle",))
    part = np.arange(len(throttle)) * 0.05, np.column_stack([throttle, 4.0 * throttle]), throttle[:, None]
    return SimpleNamespace(system=system, period=0.05, parts=lambda: [part])


def test_rows_near_which_the_others_have_less_than_a_second_are_outside():
    assert uncovered([driven(0.2, 0.4)], driven(0.2, 0.4)) == 0.0
    assert uncovered([driven(0.2, 0.4)], driven(0.3, 0.5)) == 1.0
    assert uncovered([driven(0.2, 0.4)], driven(0.4, 0.6)) == 0.5
    assert uncovered([driven(0.2), driven(0.6)], driven(0.4, 0.6)) == 0.5


def test_targets_have_the_wanted_and_the_measured_value():
    car = {"part": "car", "name": "", "change": -0.7, "added": ["a", "b"], "errors": [1.0, 0.3], "verdict": "x"}
    left_out = {**car, "name": "one.csv", "unseen_change": -0.2}
    pendulum = {"part": "pendulum", "name": "", "added": ["coulomb_friction", "torque_lag"], "errors": [1.0, 0.5, 0.4]}
    ball = {"part": "balls", "name": "Bowling Ball", "added": ["quadratic_drag"], "verdict": "effect_missing"}
    other = {"part": "balls", "name": "Golf Ball", "added": [], "verdict": "nothing_missing"}
    undecided = targets_of([{**left_out, "verdict": "undecided", "unseen_change": 0.1}])
    assert [item["met"] for item in undecided] == [True]  # honestly
    found = targets_of([car, left_out, pendulum, ball, other])
    assert [item["met"] for item in found] == [True, False, True, True, False, False]
    assert found[0]["measured"] == "-70.0 % with 2 effects"
    assert found[4]["measured"] == "torque_lag"


def test_another_robot_is_judged_by_the_effects_and_the_error_that_are_expected_of_it():
    row = {"part": "others", "name": "servo", "added": ["rate_drag"], "errors": [0.25, 0.11], "verdict": "x"}
    alone, group = ({**row, "indistinguishable": equal} for equal in ({}, {"rate_drag": ["rate_speed_limit"]}))
    assert [item["met"] for item in targets_of([alone])] == [False, True]
    assert [item["met"] for item in targets_of([group])] == [True, True]
    assert [item["met"] for item in targets_of([{**group, "errors": [0.25, 0.2]}])] == [True, False]


def test_a_folder_without_recordings_is_one_line(tmp_path, capsys):
    assert safedpa.run([*COMMAND, "--data", str(tmp_path)]) == 2
    assert "found no recording of a car" in capsys.readouterr().err
    assert safedpa.run([*COMMAND, "--data", str(tmp_path / "nowhere")]) == 2
    assert "no such folder" in capsys.readouterr().err
