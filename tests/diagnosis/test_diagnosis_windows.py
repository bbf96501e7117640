"""Which rows a window takes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safedpa.compare.windows import windows_of
from safedpa.errors import InputError, RunError
from safedpa.records.run import Stretch
from safedpa.robots.pendulum.system import PENDULUM


def test_every_tenth_used_row_starts_a_window_up_to_half_a_period_past_the_horizon(plain, drive):
    windows = windows_of([drive(plain, 10.0)], 1.02)
    assert windows.start.tolist() == list(range(0, 180, 10))
    assert set(windows.steps.tolist()) == {20}
    assert set(windows_of([drive(plain, 10.0)], 1.03).steps.tolist()) == {21}


def test_rows_outside_the_stretches_do_not_count(plain, drive):
    run = drive(plain, 10.0, stretches=[(3, 50), (60, 200)])
    windows = windows_of([run], 0.5)
    used = np.concatenate([np.arange(3, 50), np.arange(60, 200)])
    np.testing.assert_array_equal(windows.t, run.t[used])
    # the window that would start at used row 40 has 6 rows left, of which 0.5 s takes 10
    assert windows.start.tolist() == [0, 10, 20, 30, *range(50, 177, 10)]
    assert windows_of([run], 0.5, partial=True).start.tolist() == list(range(0, 181, 10))


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    cuts=st.lists(st.integers(1, 239), unique=True, max_size=5),
    horizon=st.floats(0.06, 1.0),
    stride=st.integers(1, 12),
    jitter=st.sampled_from([0.0, 0.2, 0.8]),
    partial=st.booleans(),
)
def test_no_window_crosses_a_cut(plain, drive, cuts, horizon, stride, jitter, partial):
    edges = [0, *sorted(cuts), 240]
    run = drive(plain, 12.0, jitter=jitter, stretches=list(pairwise(edges)))
    windows = windows_of([run], horizon, stride=stride, partial=partial)
    for start, end in zip(windows.start, windows.end, strict=True):
        assert start % stride == 0
        assert any(first <= start < end < stop for first, stop in pairwise(edges))
        assert run.t[end] <= run.t[start] + horizon + 0.5 * run.period + 1e-9


def test_several_runs_stand_side_by_side(plain, drive):
    runs = [drive(plain, 5.0, seed=1, name="one"), drive(plain, 8.0, seed=2, name="two", period=0.02)]
    windows = windows_of(runs, 0.5, every=0.1)
    assert np.bincount(windows.run).tolist() == [45, 75]
    assert set(windows.steps[windows.run == 0]) == {10}
    assert set(windows.steps[windows.run == 1]) == {25}
    assert (windows.time[windows.start[windows.run == 1]] < 8.0).all()
    assert (np.diff(windows.clock) > 0).all()


@pytest.mark.parametrize("horizon", [0.0, -1.0, float("nan"), float("inf")])
def test_horizon_must_be_a_positive_number(plain, drive, horizon):
    with pytest.raises(InputError, match="wanted a positive number of seconds"):
        windows_of([drive(plain, 5.0)], horizon)


def test_horizon_must_fit_the_rows(plain, drive):
    run = drive(plain, 5.0, stretches=[(0, 40), (50, 100)])
    with pytest.raises(InputError, match=r"longest stretch without a gap lasts 2\.45 s"):
        windows_of([run], 3.0)
    with pytest.raises(InputError, match=r"rows are 0\.05 s apart"):
        windows_of([run], 0.01)


def test_unusable_runs_are_refused(plain, drive):
    run = drive(plain, 5.0)
    with pytest.raises(RunError, match="got none"):
        windows_of([], 1.0)
    with pytest.raises(RunError, match="no two rows"):
        windows_of([replace(run, stretches=())], 1.0)
    with pytest.raises(RunError, match="no two rows"):
        windows_of([replace(run, stretches=(Stretch(5, 6),))], 1.0)
    states = run.states.copy()
    states[7, 1] = np.nan
    with pytest.raises(RunError, match="not finite"):
        windows_of([replace(run, states=states)], 1.0)
    with pytest.raises(RunError, match="beside simulated"):
        windows_of([run, replace(run, system=PENDULUM)], 1.0)


def test_rows_after_takes_the_nearest_row_inside_the_window(plain, drive):
    windows = windows_of([drive(plain, 10.0, jitter=0.5)], 1.0)
    for seconds in (0.001, 0.3, 0.77, 5.0):
        rows = windows.rows_after(seconds)
        for start, end, row in zip(windows.start, windows.end, rows, strict=True):
            inside = np.arange(start + 1, end + 1)
            distance = np.abs(windows.t[inside] - windows.t[start] - seconds)
            assert abs(windows.t[row] - windows.t[start] - seconds) == pytest.approx(distance.min())
