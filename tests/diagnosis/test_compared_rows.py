"""Which rows a comparison looks at: each horizon at its own time, each window's own run, and rates at 0.2 s."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from safedpa.compare.comparison import compare_model, residuals
from safedpa.compare.excerpt import without_repeated
from safedpa.compare.rollout import predict_run
from safedpa.compare.windows import windows_of
from safedpa.records.run import Stretch


def test_each_part_of_the_horizon_has_the_change_of_its_own_time(plain: Any, drive: Any) -> None:
    """The scale is the spread of x(t + h) - x(t) over all starts."""
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


@pytest.mark.parametrize("odd", range(3))
def test_the_error_of_a_run_is_that_of_its_own_windows(plain: Any, drive: Any, with_effect: Any, odd: int) -> None:
    """One of three runs is driven by another car: it alone has an error."""
    other = with_effect(plain, "viscous_drag", coefficient=0.4)
    runs = [drive(other if n == odd else plain, 8.0, n, name=f"run {n}") for n in range(3)]
    found = compare_model(plain, runs, 1.0)
    assert [run.name for run in found.runs] == ["run 0", "run 1", "run 2"]
    assert [run.error > 0.01 for run in found.runs] == [n == odd for n in range(3)]
    assert [run.rows for run in found.runs] == [160] * 3


@pytest.mark.parametrize(("parts", "near"), [((0.1, 0.2, 0.5, 1.0), 1), ((0.25, 0.5, 1.0), 0)])
def test_rates_are_those_of_the_rows_nearest_to_0_2_s(plain: Any, drive: Any, parts: Any, near: int) -> None:
    """(measured - predicted) by the time between: 0.3 m/s in 0.2 s are 1.5 m/s2."""
    windows = windows_of([drive(plain, 10.0)], 1.0)
    rows = [windows.rows_after(seconds) for seconds in parts]
    predicted = np.stack([windows.states[at] for at in rows])
    predicted[..., 3] += np.where(np.arange(len(parts)) == near, -0.3, 7.0)[:, None]
    found = residuals(windows, rows, predicted)
    assert found.seconds == pytest.approx(parts[near])
    assert found.rates[:, 3] == pytest.approx(0.3 / parts[near])
    np.testing.assert_array_equal(found.values[:, :4], windows.states[windows.start])
    np.testing.assert_array_equal(found.values[:, 4:], windows.actions[windows.start])


def test_a_table_of_predictions_has_a_row_for_each_measured_one_up_to_the_horizon(plain: Any, drive: Any) -> None:
    """0.3 s at 20 Hz, from every eighth trusted row: six rows each, but for the last, after which its stretch ends."""
    run = drive(plain, 2.0, stretches=[(0, 25), (28, 40)])
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
def test_windows_of_long_logs_start_farther_apart_and_a_finding_says_so(
    plain: Any, drive: Any, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three runs of ten seconds: a hundred windows lie 0.3 s apart; a thousand would be nearer than requested."""
    monkeypatch.setattr("safedpa.compare.comparison.MOST_WINDOWS", most)
    found = compare_model(plain, [drive(plain, 10.0, seed, name=f"run {seed}") for seed in range(3)], 1.0)
    apart = np.diff(found.windows.t[found.windows.start])
    assert np.median(apart) == pytest.approx(0.3 if most == 100 else 0.1)
    told = [finding.message for name, finding in found.findings if finding.kind == "thinned"]
    assert len(told) == (most == 100)
    assert all("start every 0.29" in text and "instead of every 0.1 s" in text for text in told)


@pytest.mark.parametrize(
    ("rows", "shared", "copy"), [(40, 40, True), (40, 21, True), (40, 20, False), (19, 19, False), (20, 20, True)]
)
def test_a_recording_of_20_rows_is_a_copy_if_more_than_half_of_them_are_in_another(
    plain: Any, drive: Any, rows: int, shared: int, copy: bool
) -> None:
    whole, other = drive(plain, 10.0, 1, name="whole"), drive(plain, 10.0, 2, name="other")
    states = np.concatenate([whole.states[50 : 50 + shared], other.states[: rows - shared]])
    actions = np.concatenate([whole.actions[50 : 50 + shared], other.actions[: rows - shared]])
    piece = replace(
        other, name="piece", t=other.t[:rows], states=states, actions=actions, stretches=(Stretch(0, rows),)
    )
    for runs in ([piece, whole], [whole, piece]):
        kept, findings = without_repeated(runs)
        assert [run.name for run in kept] == [run.name for run in runs if not (copy and run.name == "piece")]
        assert [(name, finding.count) for name, finding in findings] == ([("piece", shared)] if copy else [])


@pytest.mark.parametrize(("jitter", "reported"), [(0.15, False), (0.25, True)])
@pytest.mark.parametrize("faster", [1.0, 20.0])
def test_periods_that_vary_by_more_than_a_fifth_are_reported(
    plain: Any, drive: Any, jitter: float, reported: bool, faster: float
) -> None:
    """A tenth of the periods is longer by so much."""
    run = drive(plain, 10.0)
    steps = np.full(len(run.t) - 1, 0.05)
    steps[::10] *= 1.0 + jitter
    found = compare_model(plain, [replace(run, t=np.concatenate([[0.0], np.cumsum(steps)]) * faster)], faster)
    messages = [item.message for _, item in found.findings if item.kind == "irregular_sampling"]
    assert [" differ by more than 25%" in message for message in messages] == [True] * reported


def test_only_the_used_rows_of_a_run_are_compared(plain: Any, drive: Any) -> None:
    run = drive(plain, 10.0, stretches=[(0, 60), (80, 200)])
    found = compare_model(plain, [run], 1.0)
    (own,) = found.runs
    assert (own.rows, own.stretches, own.windows) == (180, 2, 20 + 50)
