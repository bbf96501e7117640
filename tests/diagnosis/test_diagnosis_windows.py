"""Which rows a window takes, at every limit, and which runs and horizons are refused."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safedpa.compare.windows import check_runs, windows_of
from safedpa.errors import InputError, RunError
from safedpa.records.run import Run, Stretch
from safedpa.robots.pendulum.system import PENDULUM


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


def test_rows_after_takes_the_nearest_row_inside_the_window(plain, drive):
    windows = windows_of([drive(plain, 10.0, jitter=0.5)], 1.0)
    for seconds in (0.001, 0.3, 0.77, 5.0):
        rows = windows.rows_after(seconds)
        for start, end, row in zip(windows.start, windows.end, rows, strict=True):
            inside = np.arange(start + 1, end + 1)
            distance = np.abs(windows.t[inside] - windows.t[start] - seconds)
            assert abs(windows.t[row] - windows.t[start] - seconds) == pytest.approx(distance.min())


def recording(*parts: Any, name: str = "one") -> Run:
    """Stretches with these times; the angle counts the rows, the rate is half as much, the torque three times."""
    t = np.array([second for part in parts for second in part])
    ends = np.cumsum([0, *(len(part) for part in parts)]).tolist()
    rows = np.arange(len(t), dtype=float)
    stretches = tuple(Stretch(start, stop) for start, stop in pairwise(ends))
    return Run(name, PENDULUM, t, np.stack([rows, 0.5 * rows], axis=1), 3.0 * rows[:, None], stretches)


def quarters(count: int, start: float = 0.0) -> list[float]:
    return [start + 0.25 * row for row in range(count)]


def test_the_table_holds_every_trusted_row_of_every_run() -> None:
    one = recording([], [10.0, 10.25, 10.75, 11.0], [20.0, 20.25, 20.5])
    two = recording(quarters(4, 500.0), [], name="two")
    found = windows_of([one, two], 0.5, stride=1)
    assert (found.names, found.horizon, found.system, len(found)) == (("one", "two"), 0.5, PENDULUM, 5)
    assert found.time.tolist() == [0.0, 0.25, 0.75, 1.0, 10.0, 10.25, 10.5, 0.0, 0.25, 0.5, 0.75]
    assert found.period.tolist() == [0.25, 0.5, *[0.25] * 9]
    for name in ("t", "states", "actions"):
        assert getattr(found, name).tolist() == [*getattr(one, name).tolist(), *getattr(two, name).tolist()]
    assert found.bounds.tolist() == [[0, 0], [0, 4], [4, 7], [7, 11], [11, 11]]
    columns = (found.start, found.steps, found.end, found.begin, found.run)
    wanted = [[0, 1, 4, 7, 8], [1, 1, 2, 2, 2], [1, 2, 6, 9, 10], [0, 0, 4, 7, 7], [0, 0, 0, 1, 1]]
    assert [column.tolist() for column in columns] == wanted
    assert replace(found, memo={"lag": {}}) == found, "what is remembered is no part of what windows are"
    assert "memo" not in repr(found)


@pytest.mark.parametrize(("period", "horizon"), [(0.25, 0.25), (0.25, 4.0), (4.0, 2.0), (4.0, 8.0)])
def test_between_two_stretches_the_clock_leaps_farther_than_a_window(period: float, horizon: float) -> None:
    times = period * np.arange(20)
    clock = windows_of([recording(100.0 + times, 300.0 + times), recording(7.0 + times, name="two")], horizon).clock
    assert clock[:20].tolist() == times.tolist()
    steps = np.diff(clock)
    assert (steps[[19, 39]] > horizon + 0.5 * period).all()
    assert (np.delete(steps, [19, 39]) == period).all()


@pytest.mark.parametrize(("jitter", "same"), [(0.0, True), (5e-7, True), (1e-5, False), (0.5, False)])
@pytest.mark.parametrize("period", [0.01, 4.0])
def test_rows_have_a_common_period_if_it_varies_by_a_millionth_at_most(
    period: float, jitter: float, same: bool
) -> None:
    steps = np.full(20, period)
    steps[7] *= 1.0 + jitter
    found = windows_of([recording(np.concatenate([[0.0], np.cumsum(steps)]).tolist())], 4.0 * period).common_period
    assert found == (pytest.approx(period, rel=1e-6) if same else None)


@pytest.mark.parametrize("index", [np.array([1, 4]), np.array([False, True, False, False, True])])
def test_a_selection_keeps_the_table_and_the_run_of_each_window(index: Any) -> None:
    found = windows_of([recording(quarters(9)), recording(quarters(4, 90.0), name="two")], 0.5, stride=2)
    assert (found.start.tolist(), found.run.tolist()) == ([0, 2, 4, 6, 9], [0, 0, 0, 0, 1])
    chosen = found.select(index)
    columns = (chosen.start, chosen.steps, chosen.begin, chosen.run)
    assert [column.tolist() for column in columns] == [[2, 9], [2, 2], [0, 9], [0, 1]]
    assert chosen.memo is found.memo
    assert chosen.clock is found.clock


@pytest.mark.parametrize(
    ("seconds", "rows"),
    [
        (0.0, [1, 2]), (0.01, [1, 2]), (0.25, [1, 2]), (0.37, [1, 2]), (0.375, [1, 2]), (0.38, [2, 3]), (0.5, [2, 3]),
        (0.6, [2, 3]), (0.65, [3, 4]), (0.75, [3, 4]), (9.0, [3, 4]), (-9.0, [1, 2]),
    ],
)  # fmt: skip
def test_of_two_rows_equally_near_the_earlier_one_is_taken(seconds: float, rows: list[int]) -> None:
    assert windows_of([recording(quarters(5, 40.0))], 0.75, stride=1).rows_after(seconds).tolist() == rows
    one = windows_of([recording(quarters(3, 40.0))], 0.25, stride=1)
    assert one.rows_after(seconds).tolist() == [1, 2], "each window has one row"


@pytest.mark.parametrize(
    ("options", "starts"),
    [
        ({}, [0, 10, 20, 30]), ({"stride": 15}, [0, 15, 30]), ({"every": 0.01}, range(39)),
        ({"every": 0.25}, range(39)), ({"every": 0.5}, range(0, 39, 2)),
        ({"every": 0.7}, range(0, 39, 3)), ({"every": 1.5}, range(0, 39, 6)),
    ],
)  # fmt: skip
def test_a_stride_in_seconds_is_rounded_to_rows_one_at_least(options: Any, starts: Any) -> None:
    assert windows_of([recording(quarters(40))], 0.25, **options).start.tolist() == list(starts)


@pytest.mark.parametrize("partial", [True, False])
def test_the_stride_counts_on_over_stretches_and_begins_again_with_each_run(partial: bool) -> None:
    runs = [recording(quarters(4), quarters(8, 50.0)), recording(quarters(9), name="two")]
    assert windows_of(runs, 0.25, stride=3, partial=partial).start.tolist() == [0, 6, 9, 12, 15, 18]


@pytest.mark.parametrize(
    ("horizon", "steps"),
    [(0.13, [1, 1, 1, 1]), (0.37, [1, 1, 1, 1]), (0.375, [2, 2, 2, 1]), (0.38, [2, 2, 2]), (0.62, [2, 2, 2]),
     (0.625, [3, 3, 2]), (1.125, [4])],
)  # fmt: skip
def test_a_window_ends_within_half_a_period_of_the_horizon(horizon: float, steps: list[int]) -> None:
    found = windows_of([recording(quarters(5, 40.0))], horizon, stride=1)
    assert (found.steps.tolist(), found.start.tolist()) == (steps, list(range(len(steps))))


def test_windows_that_are_cut_short_are_kept_on_request_if_one_is_whole() -> None:
    run = recording(quarters(5, 40.0), quarters(2, 90.0))
    found = windows_of([run], 1.0, stride=1, partial=True)
    assert (found.start.tolist(), found.steps.tolist()) == ([0, 1, 2, 3, 5], [4, 3, 2, 1, 1])
    assert windows_of([run], 1.0, stride=1).start.tolist() == [0]
    with pytest.raises(InputError):
        windows_of([run], 1.2, stride=1, partial=True)


LONG = (recording([], quarters(3, 60.0), quarters(7, 70.0)), recording(quarters(2), name="two"))


@pytest.mark.parametrize(
    ("runs", "horizon", "message"),
    [
        *(([recording(quarters(9))], wrong, f"got {wrong} s, wanted a positive number of seconds; choose 1, say")
          for wrong in (0.0, -1.0, float("nan"), float("inf"), float("-inf"))),
        ([recording([0.0, 0.5, 1.0], []), recording(quarters(9), name="two")], 0.1,
         "got 0.1 s, the rows are 0.25 s apart; choose at least that"),
        (LONG, 2.0, "got 2.0 s, the longest stretch without a gap lasts 1.5 s; choose a shorter horizon"),
        *(([recording(quarters(3), quarters(7, 60.0))], horizon,
           f"got {horizon} s, after no row that begins a window do rows go on for so long, though the longest stretch "
           "without a gap lasts 1.5 s; choose another horizon, or begin more windows") for horizon in (1.0, 1.5)),
        ([recording([0.0, 1.0, 1.25, 1.5])], 0.25,
         "got 0.25 s, after no row that begins a window do rows go on for so long, though the longest stretch without "
         "a gap lasts 1.5 s; choose another horizon, or begin more windows"),
    ],
)  # fmt: skip
def test_a_horizon_that_no_window_can_have_is_refused_with_the_possible_one(
    runs: Any, horizon: float, message: str
) -> None:
    with pytest.raises(InputError) as refused:
        windows_of(runs, horizon)
    assert str(refused.value) == f"horizon: {message}"


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "crane"}, {"state": PENDULUM.state[::-1]}, {"action": (replace(PENDULUM.action[0], name="push"),)},
    ],
)  # fmt: skip
def test_runs_of_different_systems_are_refused(changes: Any) -> None:
    run, system = recording(quarters(9)), replace(PENDULUM, **changes)
    check_runs([run, replace(run, name="two", system=replace(PENDULUM))])
    with pytest.raises(RunError) as refused:
        check_runs([run, replace(run, name="two", system=system)])
    assert str(refused.value) == (
        f"two: a run of robot '{system.name}' with actions {system.action_names[0]} beside one of 'pendulum' with "
        "torque; compare them one at a time"
    )


@pytest.mark.parametrize("parts", [[], [[]], [[0.0], [5.0]]])
def test_a_run_without_two_consecutive_rows_is_refused(parts: Any) -> None:
    check_runs([recording([0.0], [5.0, 5.25], [])])
    with pytest.raises(RunError, match=r"^runs: got none, wanted at least one recording$"):
        check_runs([])
    with pytest.raises(RunError, match=r"^two: no two rows that can be used follow each other"):
        windows_of([recording(quarters(2)), recording(*parts, name="two")], 0.25)


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
@pytest.mark.parametrize("field", ["states", "actions"])
def test_numbers_that_are_not_finite_are_refused_inside_a_stretch(field: str, wrong: float) -> None:
    run = recording(quarters(9), quarters(9, 50.0))
    values = getattr(run, field).copy()
    values[12, 0] = wrong
    changed: dict[str, Any] = {field: values}
    broken = replace(run, **changed)
    with pytest.raises(RunError, match=r"^one: got numbers that are not finite inside a stretch; cut those rows out$"):
        check_runs([broken])
    assert len(windows_of([replace(broken, stretches=(Stretch(0, 12), Stretch(13, 18)))], 0.25).t) == 17
