"""Windows of recordings, their folds, and commands as they are felt along them."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safedpa.compare.actuators import felt_at_once
from safedpa.compare.rollout import felt_actions
from safedpa.compare.windows import Windows, check_runs, windows_of
from safedpa.diagnosis.fit.shooting import folds_of
from safedpa.dynamics import Setting, load_model
from safedpa.effects import CommandEffect, effect, effects_of, robots
from safedpa.effects.general import general_effects
from safedpa.errors import InputError, RunError
from safedpa.operations import FLOATS
from safedpa.records.run import Run, Stretch
from safedpa.robot import robot_named
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


def simulated(plain, drive, count: int, seconds: float = 6.0) -> Windows:
    """Runs of different lengths, which no stretch of time divides evenly."""
    return windows_of([drive(plain, seconds + seed, seed=seed, name=f"run {seed}") for seed in range(count)], 0.5)


@pytest.mark.parametrize(("runs", "folds"), [(3, 6), (4, 3), (6, 6), (7, 6), (7, 2)])
def test_three_runs_or_more_are_held_out_whole(plain, drive, runs, folds):
    """A fit that has seen the other half of a run knows its day, load and battery: nothing of it is unseen then."""
    windows = simulated(plain, drive, runs)
    found = folds_of(windows, folds)
    of_run = [set(found[windows.run == run].tolist()) for run in range(runs)]
    assert all(len(one) == 1 for one in of_run)
    assert len(set().union(*of_run)) == min(runs, folds)
    sizes = np.bincount([one.pop() for one in of_run])
    assert sizes.max() - sizes.min() <= 1


@pytest.mark.parametrize("runs", [1, 2])
def test_fewer_runs_are_held_out_by_stretches_of_time(plain, drive, runs):
    windows = simulated(plain, drive, runs, 12.0)
    found = folds_of(windows, 4)
    for run in range(runs):
        own = found[windows.run == run]
        assert sorted(set(own.tolist())) == [0, 1, 2, 3]
        assert (np.diff(own) >= 0).all(), "each fold is one stretch"


def windows_of_runs(*runs: tuple[int, float]) -> Any:
    """Of each run so many windows of 1 s, one after the other, the first at so many s by its clock."""
    counts = [count for count, _ in runs]
    clock = np.concatenate([first + np.arange(count + 1) for count, first in runs])
    start = np.concatenate([np.arange(count) + sum(c + 1 for c in counts[:at]) for at, count in enumerate(counts)])
    own = {"names": "abcdef"[: len(runs)], "run": np.repeat(np.arange(len(runs)), counts), "clock": clock}
    return type("Windows", (), {**own, "start": start, "end": start + 1, "__len__": lambda _: sum(counts)})()


@pytest.mark.parametrize(
    ("runs", "folds", "found"),
    [
        (((3, 0.0), (2, 5.0), (4, 0.0)), 5, [0] * 3 + [1] * 2 + [2] * 4),  # three runs are held out whole
        (((1, 0.0), (1, 0.0), (1, 0.0), (2, 0.0)), 3, [0, 1, 2, 0, 0]),
        (((10, 0.0),), 5, [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]),  # of fewer, stretches of time in each
        (((10, 100.0), (4, 7.0)), 2, [0] * 5 + [1] * 5 + [0, 0, 1, 1]),
        (((4, 0.0), (10, 50.0)), 2, [0, 0, 1, 1] + [0] * 5 + [1] * 5),
    ],
)
def test_folds_are_runs_or_equal_stretches_of_time(runs: Any, folds: int, found: list[int]) -> None:
    assert folds_of(windows_of_runs(*runs), folds).tolist() == found


def row_by_row(command, columns, own, windows):
    """The felt columns by the effect's own equations, one row after the other in each stretch."""
    felt = {name: np.zeros(len(column)) for name, column in columns.items()}
    for begin, stop in windows.bounds.tolist():
        memory = None
        for row in range(begin, stop):
            action = {name: float(column[row]) for name, column in columns.items()}
            memory = command.initial_memory(action) if row == begin else memory
            out, memory = command.transform(action, memory, own, float(windows.period[row]), FLOATS)
            for name, column in felt.items():
                column[row] = out[name]
    return felt


@pytest.mark.parametrize("jitter", [0.0, 0.6])
@pytest.mark.parametrize("value", [0.0, 0.013, 0.05, 0.17, 0.43])
@pytest.mark.parametrize("name", ["steering_delay", "drive_delay", "actuator_delay", "steering_lag", "drive_lag"])
def test_lags_and_delays_of_whole_stretches_are_exact(plain, drive, name, value, jitter):
    run = drive(plain, 12.0, jitter=jitter, stretches=[(0, 100), (100, 101), (130, 240)])
    windows = windows_of([run], 0.5)
    columns = {key: windows.actions[:, index] for index, key in enumerate(windows.system.action_names)}
    command = effect("car", name)
    own = {command.parameters[0].name: value}
    fast, slow = felt_at_once(command, columns, own, windows), row_by_row(command, columns, own, windows)
    assert set(fast) == set(slow)
    for key, column in slow.items():
        np.testing.assert_allclose(fast[key], column, atol=1e-9)


def _remembering(robot):
    """The robot's own effects that remember commands, and those that every system has, by name."""
    system = robot_named(robot).system
    zero = dict.fromkeys(system.action_names, 0.0)
    every = {item.name: item for item in (*general_effects(system), *effects_of(robot).values())}
    commands = [item for item in every.values() if isinstance(item, CommandEffect)]
    return [item for item in commands if item.initial_memory(zero) is not None]


@pytest.mark.parametrize("robot", robots())
def test_the_actuators_of_every_robot_are_exact(robot):
    system = robot_named(robot).system
    random = np.random.default_rng(8)
    actions = np.cumsum(random.normal(0.0, 0.1, (200, len(system.action))), axis=0)
    run = Run("own", system, 0.05 * np.arange(200), np.zeros((200, len(system.state))), actions, (Stretch(0, 200),))
    windows = windows_of([run], 0.5)
    columns = {key: windows.actions[:, index] for index, key in enumerate(system.action_names)}
    assert _remembering(robot), "there is an effect to look at"
    for command in _remembering(robot):
        own = {parameter.name: 1.3 * parameter.typical for parameter in command.parameters}
        fast, slow = felt_at_once(command, columns, own, windows), row_by_row(command, columns, own, windows)
        assert fast is not None, f"{command.name} is followed row by row"
        for key, column in slow.items():
            np.testing.assert_allclose(fast[key], column, atol=1e-9, err_msg=f"{robot} {command.name}: {key}")


@pytest.mark.parametrize("width", [0.0, 0.02, 0.4, 10.0])
def test_play_of_whole_stretches_is_exact(width):
    model = load_model("dfki_pendulum")
    random = np.random.default_rng(3)
    torque = np.cumsum(random.normal(0.0, 0.1, 400))
    states = np.column_stack([np.zeros(400), random.normal(0.0, 1.0, 400)])
    stretches = (Stretch(0, 150), Stretch(150, 160), Stretch(200, 400))
    run = Run("play", model.system, 0.01 * np.arange(400), states, torque[:, None], stretches)
    windows = windows_of([run], 0.05)
    columns = {"torque": windows.actions[:, 0]}
    command, own = effect("pendulum", "backlash"), {"width": width}
    fast, slow = felt_at_once(command, columns, own, windows), row_by_row(command, columns, own, windows)
    np.testing.assert_array_equal(fast["torque"], slow["torque"])


def test_other_effects_are_left_to_their_own_equations(plain, drive):
    windows = windows_of([drive(plain, 5.0)], 0.5)
    columns = {"throttle": windows.actions[:, 0], "steer": windows.actions[:, 1]}
    assert felt_at_once(effect("car", "drive_dead_zone"), columns, {"width": 0.1}, windows) is None


@pytest.mark.parametrize("name", ["steering_delay", "drive_lag"])
def test_an_effect_of_the_user_that_remembers_commands_acts_like_one_of_the_library(plain, drive, name):
    command = effect("car", name)
    own = object.__new__(type("Own", (type(command),), {"__module__": "users"}))
    own.__dict__.update(command.__dict__)
    windows = windows_of([drive(plain, 5.0, stretches=[(0, 40), (45, 100)])], 0.5)
    value = {command.parameters[0].name: Setting(0.17)}
    library, users = (felt_actions(plain.with_effect(item, value), windows) for item in (command, own))
    assert np.abs(library - windows.actions).max() > 0.1
    np.testing.assert_allclose(users, library, atol=1e-9)
