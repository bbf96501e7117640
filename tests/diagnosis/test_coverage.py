"""Where a diagnosis is valid: which part of each range was driven, and which hardly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from safedpa.diagnosis.coverage import coverage_of, inside
from safedpa.diagnosis.document import Covered, Gap
from safedpa.dynamics import load_model
from safedpa.records.apply_map import Rows
from safedpa.records.column_map import native_map
from safedpa.records.quality import run_of_rows
from safedpa.records.run import Run, Stretch
from safedpa.report.diagnosis_story import gaps_clause
from safedpa_lab.experiments.real_logs_targets import targets_of


def driven(throttle, steer=None):
    """A recording at 20 Hz of a car with a throttle; its speed is three times that."""
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


def test_an_even_drive_has_no_gap_and_few_data_have_no_coverage():
    even = np.random.default_rng(1).uniform(0.0, 0.6, 4800)
    assert not any(item.gaps for item in coverage_of([driven(even)]))
    assert coverage_of([driven(even[:200])]) == ()
    assert coverage_of([]) == ()
    assert "throttle" not in by_name([driven(np.full(4800, 0.3))])


FULL = 400


def by_parts(*counts, level=0.0, rows=4000, period=0.0625):
    """The range of a throttle with so many rows at 0.5, 1.5 and so on; the seventh part is filled up to ``rows``.

    4000 rows in 250 s: a block is a fortieth, 100 rows.
    """
    counts = list(counts)
    counts[6] += rows - sum(counts)
    throttle = level + np.concatenate([np.full(count, part + 0.5) for part, count in enumerate(counts)])
    system, t = load_model("dart_car").system, period * np.arange(rows)
    actions = np.column_stack([throttle, 0.0 * t])
    return by_name([Run("one", system, t, np.zeros((rows, 4)), actions, (Stretch(0, rows),))]).get("throttle")


@pytest.mark.parametrize(
    ("counts", "gaps"),
    [
        ([FULL] * 10, []),
        ([FULL, FULL, 0, *[FULL] * 7], []),  # both sides say what lies in a single part
        ([FULL, FULL, 60, 39, *[FULL] * 6], [(2.3, 4.1, 99)]), ([FULL, FULL, 99, 99, *[FULL] * 6], [(2.3, 4.1, 198)]),
        ([FULL, FULL, 100, 39, *[FULL] * 6], []),  # a block is enough
        ([FULL, FULL, 0, 0, 0, 30, FULL, FULL, 0, FULL], [(2.3, 5.9, 30)]),
    ],
)  # fmt: skip
def test_a_gap_is_two_parts_of_ten_or_more_with_less_than_a_block_each(counts, gaps):
    found = by_parts(*counts)
    assert (found.seconds, found.low, found.high) == (pytest.approx(250.0), 0.5, pytest.approx(9.5))
    edges = [(gap.low, gap.high, gap.seconds) for gap in found.gaps]
    assert edges == [pytest.approx((low, high, 0.0625 * rows)) for low, high, rows in gaps]


@pytest.mark.parametrize(("end", "low", "high"), [(49, 1.5, 8.5), (60, 1.4, 8.6), (100, 0.5, 9.5)])
def test_the_ends_of_a_range_hold_half_a_block_and_its_last_parts_a_block(end, low, high):
    found = by_parts(end, *[FULL] * 8, end)
    assert (found.low, found.high) == (pytest.approx(low), pytest.approx(high))


def test_a_minute_is_needed_and_a_throttle_that_changes():
    assert by_parts(*[96] * 10, rows=976) is not None, "61 s"
    assert by_parts(*[94] * 10, rows=944) is None, "59 s"
    assert by_parts(0, 0, 0, 0, 0, 0, 4000) is None
    assert by_parts(*[FULL] * 10, level=-30.0).low == pytest.approx(-29.5), "of any sign"


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


def test_the_first_sentence_names_the_widest_gaps():
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
