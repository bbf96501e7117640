"""Values that look like another unit's, and the ones beside them that do not: some rows, written down by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.records.test_quality import car_rows

from safedpa.errors import RunError
from safedpa.records.apply_map import Rows, joined, mapped_rows
from safedpa.records.column_map import SourceColumn, TrackedPoint, native_map
from safedpa.records.quality import run_of_rows
from safedpa.records.run import Finding
from safedpa.records.sentences import finding
from safedpa.records.table import Table
from safedpa.records.values import _counted, degrees_for_radians, other_units, out_of_bounds
from safedpa.robots.car.system import CAR, CAR_THROTTLE


@pytest.mark.parametrize(("beyond", "found"), [(0.0, 0), (1e-7, 0), (1e-5, 1), (0.5, 1)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_value_is_out_of_bounds_where_it_is_beyond_more_than_its_last_digits(
    beyond: float, found: int, sign: float
) -> None:
    """By a millionth of the bound a text with six digits may be off."""
    rows = car_rows(50)
    rows.states[20, 3] = sign * CAR.state[3].high * (1.0 + beyond)
    assert CAR.state[3].low == -CAR.state[3].high
    bad, findings = out_of_bounds(rows, CAR, [True] * 4)
    assert np.flatnonzero(bad).tolist() == [20] * found
    assert [(one.kind, one.count) for one in findings] == [("out_of_bounds", 1)] * found


@pytest.mark.parametrize(
    ("first", "period", "counted"),
    [
        (0.0, 20.0, True),
        (7.0, 50.0, True),
        (0.0, 100.0, True),
        (0.5, 20.0, False),
        (0.0, 30.0, False),
        (0.0, 7.5, False),
    ],
)
def test_time_is_counted_where_it_is_whole_and_its_steps_are_round(first: float, period: float, counted: bool) -> None:
    t = first + period * np.arange(40)
    t[3] = np.nan
    assert _counted(t, period) is counted


def milliseconds(speed: float, x: list[float] | None = None, period: float = 33.5) -> Rows:
    """Rows every 33.5 ms, time written in ms, a car that drives straight on at 1 m/s and says how fast it is."""
    count = 60
    states = np.zeros((count, 4))
    states[:, 0] = 1e-3 * period * np.arange(count) if x is None else x
    states[:, 3] = speed
    return Rows(period * np.arange(count), states, np.ones((count, 2)) * (1.0, 0.1))


@pytest.mark.parametrize(("speed", "told"), [(1.0, True), (-1.0, True), (0.75, True), (0.5, False), (2.0, False)])
def test_milliseconds_are_told_where_a_car_then_moves_as_fast_as_it_says(speed: float, told: bool) -> None:
    bad, findings = other_units(milliseconds(speed), CAR, native_map(CAR))
    assert [one.kind for one in findings] == ["unit_mistake"] * told
    assert bad.all() == bad.any() == told


@pytest.mark.parametrize("state", [0, 1, 3])
def test_a_row_without_a_number_does_not_hide_that_times_are_milliseconds(state: int) -> None:
    rows = milliseconds(1.0)
    rows.states[30, state] = np.nan
    (found,) = other_units(rows, CAR, native_map(CAR))[1]
    assert "it looks like ms, not seconds" in found.message


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_of_a_car_that_stands_no_unit_of_time_is_told(speed: float) -> None:
    assert other_units(milliseconds(speed, [2.0] * 60), CAR, native_map(CAR))[1] == []


@pytest.mark.parametrize(
    ("usual", "seldom", "told"),
    [(50.0, 50.0, True), (100.0, 100.0, True), (2.0, 2.0, True), (1.25, 1.25, False), (0.5, 50.0, False),
     (150.0, 150.0, False), (0.5, 0.5, False)],
)  # fmt: skip
def test_a_command_is_percent_where_it_is_often_beyond_all_and_up_to_a_hundred(
    usual: float, seldom: float, told: bool
) -> None:
    """Of a hundred rows ten are the seldom ones."""
    values = np.where(np.arange(100) % 10 == 0, seldom, usual) * np.where(np.arange(100) % 2, 1.0, -1.0)
    rows = Rows(0.05 * np.arange(100), np.zeros((100, 4)), np.column_stack([values, np.zeros(100)]))
    found = other_units(rows, CAR_THROTTLE, native_map(CAR_THROTTLE))[1]
    assert [one.message.startswith(f"{CAR_THROTTLE.action_names[0]} reaches") for one in found] == [True] * told


def test_an_angle_that_nobody_commanded_is_not_judged() -> None:
    rows = car_rows(50)
    rows.actions[:, 1] = np.nan
    bad, findings = degrees_for_radians(rows, CAR)
    assert (bad.any(), findings) == (False, [])


@pytest.mark.parametrize(
    ("start", "done", "said"),
    [(None, "", "2 rows"), (12.3456, "", "2 rows, first at t = 12.346 s"), (float("nan"), "", "2 rows"),
     (float("inf"), "cut out", "2 rows; cut out"), (0.0, "cut out", "2 rows, first at t = 0.000 s; cut out")],
)  # fmt: skip
def test_when_something_was_first_is_told_where_it_is_known(start: float | None, done: str, said: str) -> None:
    assert finding("kind", "2 rows", 2, start, done).message == said


def test_a_tracked_point_of_no_row_is_nowhere() -> None:
    """The name of what is then wrong is told by whoever looks at the rows."""
    columns = replace(native_map(CAR), tracked_point=TrackedPoint(ahead=0.1))
    rows = mapped_rows(Table({name: np.empty(0) for name in columns.sources}, ()), columns, CAR)
    assert (len(rows.t), rows.actions.shape) == (0, (0, 2))


@pytest.mark.parametrize("findings", [(), (Finding("comment_lines", "two lines were left out", 2),)])
def test_a_table_without_a_row_is_refused_with_what_was_found(findings: tuple[Finding, ...]) -> None:
    empty = Rows(np.empty(0), np.empty((0, 4)), np.empty((0, 2)))
    with pytest.raises(RunError) as caught:
        run_of_rows(Path("a.csv"), CAR, native_map(CAR), empty, findings)
    assert str(caught.value).startswith("a.csv: no rows")
    assert ("two lines were left out" in str(caught.value)) == bool(findings)


NONE = float("nan")


@pytest.mark.parametrize(
    ("join", "found"),
    [
        ("first", [3.0, 5.0, 2.0, NONE]),
        ("sum", [7.0, NONE, NONE, NONE]),
        ("mean", [3.5, NONE, NONE, NONE]),
        ("difference", [-1.0, NONE, NONE, NONE]),
        ("norm", [5.0, NONE, NONE, NONE]),
    ],
)
def test_two_columns_become_one(join: str, found: list[float]) -> None:
    """3 and 4; 5 and nothing; nothing and 2; nothing at all."""
    table = Table({"a": np.array([3.0, 5.0, NONE, NONE]), "b": np.array([4.0, NONE, 2.0, NONE])}, ())
    column = SourceColumn("a", others=("b",), join=join)
    np.testing.assert_array_equal(joined(table, column), found)
