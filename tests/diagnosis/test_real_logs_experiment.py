"""``safedpa experiment real-logs`` in small: balls as they are, the car on two of its logs with a library of two."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.effects import effect
from safedpa_lab.experiments.real_logs_cover import uncovered
from safedpa_lab.experiments.real_logs_data import CAR, paths_of
from safedpa_lab.experiments.real_logs_targets import targets_of
from safedpa_services.command_line.group import safedpa

COMMAND = ["experiment", "real-logs", "--processes", "1"]


@pytest.mark.long
def test_the_balls_meet_their_targets(data, tmp_path, capsys):
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


def test_a_folder_without_recordings_is_one_line(tmp_path, capsys):
    assert safedpa.run([*COMMAND, "--data", str(tmp_path)]) == 2
    assert "found none of" in capsys.readouterr().err
    assert safedpa.run([*COMMAND, "--data", str(tmp_path / "nowhere")]) == 2
    assert "no such folder" in capsys.readouterr().err
