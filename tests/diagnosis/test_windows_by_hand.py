"""Which rows a window takes, at every limit, and what is refused: by hand, of rows a quarter of a second apart."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from safedpa.compare.windows import Windows, check_runs, windows_of
from safedpa.errors import InputError, RunError
from safedpa.records.run import Run, Stretch
from safedpa.robots.pendulum.system import PENDULUM


def recording(*parts: Any, name: str = "one") -> Run:
    """Of stretches with these times; the angle counts the rows, the rate is half as much, the torque three times."""
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
    assert found.names == ("one", "two")
    assert found.horizon == 0.5
    assert found.system is PENDULUM
    assert found.t.tolist() == [*one.t, *two.t]
    assert found.time.tolist() == [0.0, 0.25, 0.75, 1.0, 10.0, 10.25, 10.5, 0.0, 0.25, 0.5, 0.75]
    assert found.period.tolist() == [0.25, 0.5, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25]
    assert found.states.tolist() == [*one.states.tolist(), *two.states.tolist()]
    assert found.actions.tolist() == [*one.actions.tolist(), *two.actions.tolist()]
    assert found.bounds.tolist() == [[0, 0], [0, 4], [4, 7], [7, 11], [11, 11]]
    assert found.start.tolist() == [0, 1, 4, 7, 8]
    assert found.steps.tolist() == [1, 1, 2, 2, 2]
    assert found.end.tolist() == [1, 2, 6, 9, 10]
    assert found.begin.tolist() == [0, 0, 4, 7, 7]
    assert found.run.tolist() == [0, 0, 0, 1, 1]
    assert len(found) == 5


@pytest.mark.parametrize(("period", "horizon"), [(0.25, 0.25), (0.25, 0.5), (0.25, 4.0), (4.0, 2.0), (4.0, 8.0)])
def test_the_clock_is_time_within_a_stretch_and_between_two_it_leaps_farther_than_a_window(
    period: float, horizon: float
) -> None:
    """Also of rows so far apart that a window may have one."""
    times = period * np.arange(20)
    clock = windows_of([recording(100.0 + times, 300.0 + times), recording(7.0 + times, name="two")], horizon).clock
    assert clock[:20].tolist() == times.tolist()
    steps = np.diff(clock)
    assert (steps[[19, 39]] > horizon + 0.5 * period).all()
    assert (np.delete(steps, [19, 39]) == period).all()


def test_what_is_remembered_is_no_part_of_what_windows_are() -> None:
    found = windows_of([recording(quarters(9))], 0.5)
    assert replace(found, memo={"lag": {}}) == found
    assert "memo" not in repr(found)


@pytest.mark.parametrize(("jitter", "same"), [(0.0, True), (5e-7, True), (1e-5, False), (0.5, False)])
@pytest.mark.parametrize("period", [0.01, 4.0])
def test_rows_have_one_period_to_a_millionth_of_it(period: float, jitter: float, same: bool) -> None:
    """Beyond that each row keeps its own."""
    steps = np.full(20, period)
    steps[7] *= 1.0 + jitter
    times = np.concatenate([[0.0], np.cumsum(steps)])
    found = windows_of([recording(times.tolist())], 4.0 * period).common_period
    assert found == (pytest.approx(period, rel=1e-6) if same else None)


def test_a_selection_keeps_table_and_memory() -> None:
    found = windows_of([recording(quarters(9), quarters(4, 90.0))], 0.5, stride=2)
    assert found.start.tolist() == [0, 2, 4, 6, 10]
    for index in (np.array([1, 4]), np.array([False, True, False, False, True])):
        chosen = found.select(index)
        assert (chosen.start.tolist(), chosen.steps.tolist()) == ([2, 10], [2, 2])
        assert (chosen.begin.tolist(), chosen.run.tolist()) == ([0, 9], [0, 0])
        assert chosen.memo is found.memo
        assert chosen.clock is found.clock


@pytest.mark.parametrize(
    ("seconds", "rows"),
    [
        (0.0, [1, 2]), (0.01, [1, 2]), (0.25, [1, 2]), (0.37, [1, 2]), (0.375, [1, 2]), (0.38, [2, 3]), (0.5, [2, 3]),
        (0.6, [2, 3]), (0.65, [3, 4]), (0.75, [3, 4]), (9.0, [3, 4]), (-9.0, [1, 2]),
    ],
)  # fmt: skip
def test_the_nearest_row_after_the_start_and_of_two_as_near_the_earlier(seconds: float, rows: list[int]) -> None:
    found = windows_of([recording(quarters(5, 40.0))], 0.75, stride=1)
    assert found.rows_after(seconds).tolist() == rows


def test_after_one_row_alone_comes_that_row() -> None:
    found = windows_of([recording(quarters(3, 40.0))], 0.25, stride=1)
    assert [found.rows_after(seconds).tolist() for seconds in (0.0, 0.3, 2.0)] == [[1, 2]] * 3


def test_every_tenth_row_begins_a_window_unless_it_is_said_otherwise() -> None:
    run = recording(quarters(40))
    assert windows_of([run], 0.5).start.tolist() == [0, 10, 20, 30]
    assert windows_of([run], 0.5, stride=15).start.tolist() == [0, 15, 30]


@pytest.mark.parametrize(("every", "stride"), [(0.01, 1), (0.25, 1), (0.5, 2), (0.7, 3), (1.5, 6)])
def test_so_many_seconds_are_so_many_rows_and_one_at_least(every: float, stride: int) -> None:
    assert windows_of([recording(quarters(12))], 0.25, every=every).start.tolist() == list(range(0, 11, stride))


def test_rows_are_counted_anew_in_every_run_and_on_over_its_stretches() -> None:
    runs = [recording(quarters(4), quarters(8, 50.0)), recording(quarters(9), name="two")]
    assert windows_of(runs, 0.25, stride=3).start.tolist() == [0, 6, 9, 12, 15, 18]
    assert windows_of(runs, 0.25, stride=3, partial=True).start.tolist() == [0, 6, 9, 12, 15, 18]


@pytest.mark.parametrize(
    ("horizon", "steps"),
    [(0.13, [1, 1, 1, 1]), (0.37, [1, 1, 1, 1]), (0.375, [2, 2, 2, 1]), (0.38, [2, 2, 2]), (0.62, [2, 2, 2]),
     (0.625, [3, 3, 2]), (1.125, [4])],
)  # fmt: skip
def test_a_window_goes_to_half_a_period_past_the_horizon_and_lacks_half_a_period_at_most(
    horizon: float, steps: list[int]
) -> None:
    """0.375 s: the row at 0.5 s is half a period past it, that at 0.25 s half a period short of it."""
    found = windows_of([recording(quarters(5, 40.0))], horizon, stride=1)
    assert found.steps.tolist() == steps
    assert found.start.tolist() == list(range(len(steps)))


def test_cut_windows_are_kept_where_they_are_asked_for_if_one_is_whole() -> None:
    run = recording(quarters(5, 40.0), quarters(2, 90.0))
    found = windows_of([run], 1.0, stride=1, partial=True)
    assert found.start.tolist() == [0, 1, 2, 3, 5]
    assert found.steps.tolist() == [4, 3, 2, 1, 1]
    assert windows_of([run], 1.0, stride=1).start.tolist() == [0]
    with pytest.raises(InputError):
        windows_of([run], 1.2, stride=1, partial=True)


def test_a_runs_period_is_worked_out_once_whatever_the_number_of_its_stretches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is a median over all of them: once for each of them, a log of a thousand gaps takes half a minute."""
    asked: list[int] = []
    median = np.median

    def counted(values: Any) -> Any:
        asked.append(len(values))
        return median(values)

    monkeypatch.setattr(np, "median", counted)
    windows_of([recording(*(quarters(4, 10.0 * part) for part in range(30)))], 0.5, every=0.25)
    assert asked == [90]


@pytest.mark.parametrize("horizon", [0.0, -1.0, float("nan"), float("inf"), float("-inf")])
def test_no_horizon_is_refused(horizon: float) -> None:
    with pytest.raises(InputError) as told:
        windows_of([recording(quarters(9))], horizon)
    assert str(told.value) == f"horizon: got {horizon} s, wanted a positive number of seconds; choose 1, say"


def test_a_horizon_within_a_row_is_told_the_shortest_distance_of_rows() -> None:
    runs = [recording([0.0, 0.5, 1.0], []), recording(quarters(9), name="two")]
    with pytest.raises(InputError) as told:
        windows_of(runs, 0.1)
    assert str(told.value) == "horizon: got 0.1 s, the rows are 0.25 s apart; choose at least that"


def test_a_horizon_beyond_every_stretch_is_told_the_longest() -> None:
    runs = [recording([], quarters(3, 60.0), quarters(7, 70.0)), recording(quarters(2), name="two")]
    with pytest.raises(InputError) as told:
        windows_of(runs, 2.0)
    longest = "horizon: got 2.0 s, the longest stretch without a gap lasts 1.5 s; choose a shorter horizon"
    assert str(told.value) == longest


@pytest.mark.parametrize("horizon", [1.0, 1.5])
def test_where_no_window_begins_in_the_stretch_that_is_long_enough_that_is_told(horizon: float) -> None:
    """Every tenth row begins one: the first of the short stretch, and none of the long one."""
    run = recording(quarters(3), quarters(7, 60.0))
    with pytest.raises(InputError) as told:
        windows_of([run], horizon)
    wanted = (
        f"horizon: got {horizon} s, after no row that begins a window do rows go on for so long, though the longest "
        "stretch without a gap lasts 1.5 s; choose another horizon, or begin more windows"
    )
    assert str(told.value) == wanted
    assert windows_of([run], horizon, stride=1).start[-1] >= 3


def test_a_horizon_of_one_period_of_which_no_window_begins_is_not_called_too_short() -> None:
    with pytest.raises(InputError, match="begin more windows"):
        windows_of([recording([0.0, 1.0, 1.25, 1.5])], 0.25)


def test_what_cannot_be_compared_is_refused() -> None:
    run = recording(quarters(9))
    with pytest.raises(RunError) as told:
        check_runs([])
    assert str(told.value) == "runs: got none, wanted at least one recording"
    for system in (
        replace(PENDULUM, name="crane"),
        replace(PENDULUM, state=PENDULUM.state[::-1]),
        replace(PENDULUM, action=(replace(PENDULUM.action[0], name="push"),)),
    ):
        with pytest.raises(RunError) as told:
            check_runs([run, replace(run, name="two", system=system)])
        assert str(told.value) == (
            f"two: a run of robot '{system.name}' with actions {system.action_names[0]} beside one of 'pendulum' with "
            "torque; compare them one at a time"
        )
    check_runs([run, replace(run, name="two", system=replace(PENDULUM))])


def test_two_rows_that_follow_each_other_are_wanted_of_every_run() -> None:
    check_runs([recording([0.0], [5.0, 5.25], [])])
    for parts in ([], [[]], [[0.0], [5.0]]):
        with pytest.raises(RunError) as told:
            check_runs([recording(quarters(2)), recording(*parts, name="two")])
        assert str(told.value) == ("two: no two rows that can be used follow each other; see its data quality findings")


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
@pytest.mark.parametrize("field", ["states", "actions"])
def test_numbers_that_are_not_finite_are_refused_inside_a_stretch(field: str, wrong: float) -> None:
    run = recording(quarters(9), quarters(9, 50.0))
    values = getattr(run, field).copy()
    values[12, 0] = wrong
    changed: dict[str, Any] = {field: values}
    broken = replace(run, **changed)
    with pytest.raises(RunError) as told:
        check_runs([broken])
    assert str(told.value) == "one: got numbers that are not finite inside a stretch; cut those rows out"
    check_runs([replace(broken, stretches=(Stretch(0, 12), Stretch(13, 18)))])
    found: Windows = windows_of([replace(broken, stretches=(Stretch(0, 12), Stretch(13, 18)))], 0.25)
    assert len(found.t) == 17
