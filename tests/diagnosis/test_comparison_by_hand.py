"""Which rows a comparison looks at: each horizon at its own time, each window's own run, and rates at 0.2 s."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.compare.comparison import compare_model, residuals
from safedpa.compare.rollout import predict_run
from safedpa.compare.where import factors
from safedpa.compare.windows import windows_of
from safedpa.records.run import Run, Stretch
from safedpa.robots.car.system import CAR_THROTTLE


def test_at_each_part_of_the_horizon_the_change_is_that_of_its_own_time(plain, drive):
    """scale is the spread of x(t + h) - x(t) over all starts; no window may be looked at earlier or later."""
    run = drive(plain, 30.0)
    found = compare_model(plain, [run], 1.0)
    assert [part.seconds for part in found.horizons] == pytest.approx(np.arange(1, 11) / 10.0)
    for part in found.horizons:
        rows = round(part.seconds / 0.05)
        starts = np.arange(0, len(run.t) - 20, 2)
        speed = run.states[starts + rows, 3] - run.states[starts, 3]
        assert part.errors["no_change"].scale[3] == pytest.approx(speed.std(), rel=1e-6)
        assert part.errors["model"].value == pytest.approx(0.0, abs=1e-9)
        assert min(part.errors[name].value for name in ("no_change", "constant_velocity")) > 0.1


def test_a_choice_of_windows_keeps_each_ones_run_and_rows(plain, drive):
    runs = [drive(plain, seconds, seed, name=f"run {seed}") for seed, seconds in enumerate((4.0, 5.0, 6.0))]
    windows = windows_of(runs, 0.5)
    assert sorted(set(windows.run.tolist())) == [0, 1, 2]
    for chosen in (np.array([0, 5, len(windows) - 1]), np.arange(len(windows)) % 3 == 1, windows.run == 1):
        few = windows.select(chosen)
        whole = np.arange(len(windows))[chosen]
        for name in ("start", "steps", "begin", "run"):
            assert getattr(few, name).tolist() == [int(getattr(windows, name)[at]) for at in whole]
    assert set(windows.select(windows.run == 1).run.tolist()) == {1}


def test_an_error_of_a_run_is_that_of_its_own_windows(plain, drive, with_effect):
    """One of three runs is driven by another car: it alone has an error, first, in the middle or last."""
    other = with_effect(plain, "viscous_drag", coefficient=0.4)
    for odd in range(3):
        runs = [drive(other if n == odd else plain, 8.0, n, name=f"run {n}") for n in range(3)]
        found = compare_model(plain, runs, 1.0)
        assert [run.name for run in found.runs] == ["run 0", "run 1", "run 2"]
        assert [run.error > 0.01 for run in found.runs] == [n == odd for n in range(3)]
        assert [run.rows for run in found.runs] == [160] * 3


@pytest.mark.parametrize("late", [False, True])
def test_rates_are_those_of_the_rows_nearest_to_a_fifth_of_a_second(plain, drive, late):
    """measured - predicted, by the time between: 0.3 m/s in 0.2 s are 1.5 m/s2, whatever stands at other rows."""
    windows = windows_of([drive(plain, 10.0)], 1.0)
    parts = (0.1, 0.2, 0.5, 1.0) if not late else (0.25, 0.5, 1.0)
    rows = [windows.rows_after(seconds) for seconds in parts]
    predicted = np.stack([windows.states[at] for at in rows])
    near = 0 if late else 1
    predicted[near, :, 3] -= 0.3
    for other in {*range(len(parts))} - {near}:
        predicted[other, :, 3] += 7.0
    found = residuals(windows, rows, predicted)
    assert found.seconds == pytest.approx(parts[near])
    assert found.rates[:, 3] == pytest.approx(0.3 / parts[near])
    np.testing.assert_array_equal(found.values[:, :4], windows.states[windows.start])
    np.testing.assert_array_equal(found.values[:, 4:], windows.actions[windows.start])


def test_a_table_of_predictions_has_a_row_for_each_measured_one_up_to_the_horizon(plain, drive):
    """0.3 s at 20 Hz, from every eighth trusted row: six rows each, but for the last, behind which its stretch ends."""
    run = drive(plain, 2.0, stretches=[(0, 25), (28, 40)])
    assert run.stretches == (Stretch(0, 25), Stretch(28, 40))
    expected = [
        (start, row) for start, last in ((0, 6), (8, 14), (16, 22), (35, 39)) for row in range(start + 1, last + 1)
    ]
    found = predict_run(plain, run, 0.3, stride=8)
    assert set(found) == {"start_t", "t", "x", "y", "yaw", "speed"}
    starts, rows = (np.array(column) for column in zip(*expected, strict=True))
    np.testing.assert_allclose(found["start_t"], run.t[starts])
    np.testing.assert_allclose(found["t"], run.t[rows])
    for index, name in enumerate(run.system.state_names):
        np.testing.assert_allclose(found[name], run.states[rows, index], atol=1e-9)
    assert np.abs(run.states[rows] - run.states[rows - 1]).max(axis=1).min() > 1e-3, "a row late would show"


@pytest.mark.parametrize("most", [100, 1000])
def test_windows_of_long_logs_start_farther_apart_by_the_time_of_all_of_them(plain, drive, most, monkeypatch):
    """Three runs of ten seconds: a hundred windows lie 0.3 s apart; a thousand would lie nearer than is asked for."""
    monkeypatch.setattr("safedpa.compare.comparison.MOST_WINDOWS", most)
    runs = [drive(plain, 10.0, seed, name=f"run {seed}") for seed in range(3)]
    found = compare_model(plain, runs, 1.0)
    apart = np.diff(found.windows.t[found.windows.start])
    assert np.median(apart) == pytest.approx(0.3 if most == 100 else 0.1)
    told = [finding.message for name, finding in found.findings if finding.kind == "thinned"]
    assert len(told) == (most == 100)
    assert all("start every 0.298 s instead of every 0.1 s" in text or "every 0.299 s" in text for text in told)


def test_a_window_counts_where_its_states_are_in_the_mean_and_its_actions_as_long_as_they_act():
    """Windows of one step: from 1 to 3 m/s and from 5 to 7 m/s; what is commanded at their ends acts behind them."""
    row = np.arange(80)
    speed = np.where(row < 40, 1.0, 5.0) + 2.0 * (row % 2)
    throttle = np.where(row % 2, 0.9, np.where(row < 40, 0.2, 0.6))
    states = np.column_stack([np.zeros((80, 3)), speed])
    run = Run("steps", CAR_THROTTLE, 0.1 * row, states, np.column_stack([throttle, np.zeros(80)]), (Stretch(0, 80),))
    windows = windows_of([run], 0.1, stride=2)
    assert windows.steps.tolist() == [1] * 40
    errors = np.zeros((40, 4))
    errors[:, 3] = np.where(np.arange(40) < 20, 1.0, 2.0)
    found = {item.variable: item for item in factors(windows, errors, np.array([0.0, 0.0, 0.0, 1.0]))}
    for name, means in (("speed", (2.0, 6.0)), ("throttle", (0.2, 0.6))):
        slow, fast = found[name].bins
        assert slow.low <= means[0] < slow.high
        assert fast.low <= means[1] <= fast.high
        assert means[0] - 0.1 <= slow.low, "no bin begins far below the least mean"
        assert fast.high <= means[1] + 0.1, "nor ends far above the largest"
        assert [(one.samples, one.error) for one in (slow, fast)] == [(20, 1.0), (20, 2.0)]
        assert found[name].explained == pytest.approx(1.0)
