"""Where a diagnosis holds: what of each range was driven, and what hardly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from safedpa.diagnosis.coverage import coverage_of, inside
from safedpa.dynamics import load_model
from safedpa.records.apply_map import Rows
from safedpa.records.column_map import native_map
from safedpa.records.quality import run_of_rows
from safedpa.report.diagnosis_story import gaps_clause
from safedpa_lab.experiments.real_logs_targets import targets_of


def driven(throttle, steer=None):
    """A recording at 20 Hz of a car that does nothing but be told a throttle; its speed is three times that."""
    system = load_model("dart_car").system
    throttle = np.asarray(throttle)
    t = 0.05 * np.arange(len(throttle))
    steer = 0.3 * np.sin(t) if steer is None else steer
    states = np.column_stack([t, t, 0.0 * t, 3.0 * throttle])
    made = Rows(t, states, np.column_stack([throttle, steer]))
    return run_of_rows(Path("drive.csv"), system, native_map(system), made, ())


def two_throttles():
    """Half a minute about 0.01, two minutes between 0.4 and 0.6, and hardly anything between."""
    slow, fast = (at + size * np.sin(0.7 * np.arange(2400) * 0.05) for at, size in ((0.01, 0.01), (0.5, 0.1)))
    return driven(np.concatenate([slow[:600], np.linspace(0.02, 0.4, 20), fast]))


def by_name(runs):
    return {item.variable: item for item in coverage_of(runs)}


def test_a_throttle_that_was_passed_through_only_is_a_gap():
    found = by_name([two_throttles()])
    assert set(found) == {"speed", "throttle", "steer"}  # neither a place nor an angle
    throttle = found["throttle"]
    assert throttle.low == pytest.approx(0.0, abs=0.01)
    assert throttle.high == pytest.approx(0.6, abs=0.01)
    (gap,) = throttle.gaps
    assert gap.low == pytest.approx(0.06, abs=0.01)
    assert gap.high == pytest.approx(0.42, abs=0.07)
    assert gap.seconds < 3.0
    assert not found["steer"].gaps


def test_what_was_driven_evenly_has_no_gap_and_few_data_say_nothing():
    even = np.random.default_rng(1).uniform(0.0, 0.6, 4800)
    assert not any(item.gaps for item in coverage_of([driven(even)]))
    assert coverage_of([driven(even[:200])]) == ()
    assert coverage_of([]) == ()
    assert "throttle" not in by_name([driven(np.full(4800, 0.3))])


def test_rows_in_a_gap_or_beyond_the_range_lie_outside():
    run = two_throttles()
    tried = np.array([0.02, 0.2, 0.5, 0.8])
    states = np.column_stack([0 * tried, 0 * tried, 0 * tried, 3.0 * tried])
    said = inside(coverage_of([run]), run.system, states, np.column_stack([tried, 0 * tried]))
    assert said.tolist() == [True, False, True, False]


def test_the_first_sentence_tells_the_widest_gaps():
    throttle = {"variable": "throttle", "unit": "1", "low": 0.0, "high": 0.6, "seconds": 270.0}
    gaps = [{"low": 0.08, "high": 0.32, "seconds": 9.2}]
    told = gaps_clause({"coverage": [{**throttle, "gaps": gaps}]})
    assert "throttle 0.08 to 0.32 (9 of 270 s)" in told
    assert gaps_clause({"coverage": [{**throttle, "gaps": []}]}) == ""
    assert gaps_clause({}) == ""


def test_a_log_that_was_left_out_is_judged_also_where_the_others_say_that_they_hold():
    row = {"part": "car", "name": "one.csv", "change": -0.7, "added": ["a"], "verdict": "x", "unseen_change": -0.1}
    found = targets_of([{**row, "unseen_told": 0.2, "unseen_where_told": [0.5, 0.3]}])
    assert [item["met"] for item in found] == [False, True]
    assert found[1]["measured"] == "-40.0 %; 20 % of its predictions lie there"
