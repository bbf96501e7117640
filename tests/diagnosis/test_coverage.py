"""Where a diagnosis holds: what of each range was driven, and what hardly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from safedpa.diagnosis.coverage import _covered, coverage_of, inside
from safedpa.diagnosis.document import Covered, Gap
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


def by_parts(*counts, level=0.0, period=0.0625):
    """The range of one action with so many rows at 0.5, 1.5 and so on."""
    table = np.concatenate([np.full(count, part + 0.5) for part, count in enumerate(counts)])
    variable = load_model("dart_car").system.action[0]
    return _covered(variable, level + table, np.full(len(table), period), 6.25)


def ends(found):
    return (found.low, found.high, [(gap.low, gap.high, gap.seconds) for gap in found.gaps])


def test_parts_gaps_and_ends_by_hand():
    """A block is 6.25 s, 100 rows; values at 0.5, 1.5 to 9.5: ten parts of 0.9."""
    full = 400
    whole = by_parts(*[full] * 10)
    assert (whole.seconds, ends(whole)) == (pytest.approx(250.0), (0.5, pytest.approx(9.5), []))
    held = by_parts(full, full, 0, full, full, full, full, full, full, full)
    assert ends(held)[2] == [], "what lies between two that are held is told by both sides"
    gap = by_parts(full, full, 60, 39, full, full, full, full, full, full)
    assert ends(gap)[2] == [(pytest.approx(2.3), pytest.approx(4.1), pytest.approx(99 * 0.0625))]
    enough = by_parts(full, full, 100, 39, full, full, full, full, full, full)
    assert ends(enough)[2] == [], "a block is enough"
    less = by_parts(full, full, 99, 99, full, full, full, full, full, full)
    assert len(ends(less)[2]) == 1
    long = by_parts(full, full, 0, 0, 0, 30, full, full, 0, full)
    assert ends(long)[2] == [(pytest.approx(2.3), pytest.approx(5.9), pytest.approx(30 * 0.0625))]


def test_ends_that_hold_less_than_a_block_are_not_held():
    """Half a block beyond is left out of the range; a last part of less than a block ends it."""
    full = 400
    few = by_parts(49, full, full, full, full, full, full, full, full, 49)
    assert ends(few)[:2] == (1.5, pytest.approx(8.5)), "less than 50 rows lie there"
    some = by_parts(60, full, full, full, full, full, full, full, full, 60)
    assert ends(some)[:2] == (pytest.approx(1.4), pytest.approx(8.6)), "a tenth of 0.5 to 9.5 that holds 60 rows"
    block = by_parts(100, full, full, full, full, full, full, full, full, 100)
    assert ends(block)[:2] == (0.5, pytest.approx(9.5))


def test_of_less_than_twenty_blocks_nothing_is_said():
    """125 s."""
    assert by_parts(*[200] * 10) is not None
    assert by_parts(*[200] * 9, 199) is None
    assert by_parts(*[0] * 3, 4000) is None, "it does not change"
    assert by_parts(*[300] * 10, period=0.03125) is None
    assert by_parts(*[300] * 10, level=-30.0).low == pytest.approx(-29.5), "of any sign"


def test_a_range_holds_both_its_ends_and_a_gap_its_lower_one():
    system = load_model("dart_car").system
    found = [Covered("throttle", "1", 0.0, 1.0, 200.0, (Gap(0.4, 0.6, 1.0),))]
    tried = np.array([-1e-9, 0.0, 0.4 - 1e-9, 0.4, 0.6 - 1e-9, 0.6, 1.0, 1.0 + 1e-9])
    said = inside(found, system, np.zeros((8, 4)), np.column_stack([tried, 0 * tried]))
    assert said.tolist() == [False, True, True, False, False, True, True, False]


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
