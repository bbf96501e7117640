"""Values beyond their bounds or in another unit, and the ones that only look like it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.records.test_quality import car_rows

from safedpa.errors import RunError
from safedpa.records.column_map.apply import joined_column, mapped_rows
from safedpa.records.column_map.column_map import SourceColumn, TrackedPoint, native_map
from safedpa.records.quality.findings import finding
from safedpa.records.quality.quality import run_of_rows
from safedpa.records.quality.values import degrees_for_radians, other_units, out_of_bounds
from safedpa.records.readers.table import Table
from safedpa.records.run import Finding, RawRows
from safedpa.robots.car.system import CAR, CAR_THROTTLE

NONE = float("nan")


@pytest.mark.parametrize(("beyond", "found"), [(0.0, 0), (1e-7, 0), (1e-5, 1), (0.5, 1)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_value_is_out_of_bounds_beyond_a_millionth_of_the_bound(beyond: float, found: int, sign: float) -> None:
    """A text with six digits may be off by that much."""
    rows = car_rows(50)
    rows.states[20, 3] = sign * CAR.state[3].high * (1.0 + beyond)
    assert CAR.state[3].low == -CAR.state[3].high
    bad, findings = out_of_bounds(rows, CAR, [True] * 4)
    assert np.flatnonzero(bad).tolist() == [20] * found
    assert [(one.kind, one.count) for one in findings] == [("out_of_bounds", 1)] * found


def milliseconds(speed: float, x: list[float] | None = None, period: float = 33.5, first: float = 0.0) -> RawRows:
    """A car that drives straight on at 1 m/s and reports ``speed``; time in ms."""
    count = 60
    states = np.zeros((count, 4))
    states[:, 0] = 1e-3 * period * np.arange(count) if x is None else x
    states[:, 3] = speed
    return RawRows(first + period * np.arange(count), states, np.ones((count, 2)) * (1.0, 0.1))


@pytest.mark.parametrize(("speed", "recognised"), [(1.0, True), (-1.0, True), (0.75, True), (0.5, False), (2.0, False)])
def test_milliseconds_are_recognised_where_the_car_then_moves_as_fast_as_reported(speed: float, recognised: bool):
    bad, findings = other_units(milliseconds(speed), CAR, native_map(CAR))
    assert [one.kind for one in findings] == ["unit_mistake"] * recognised
    assert bad.all() == bad.any() == recognised


@pytest.mark.parametrize("state", [0, 1, 3])
def test_a_missing_value_does_not_hide_milliseconds(state: int) -> None:
    rows = milliseconds(1.0)
    rows.states[30, state] = np.nan
    (found,) = other_units(rows, CAR, native_map(CAR))[1]
    assert "it looks like ms, not seconds" in found.message


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_no_unit_of_time_is_recognised_from_a_stationary_car(speed: float) -> None:
    assert other_units(milliseconds(speed, [2.0] * 60), CAR, native_map(CAR))[1] == []


@pytest.mark.parametrize(
    ("first", "period", "recognised"),
    [(0.0, 20.0, True), (7.0, 50.0, True), (0.0, 100.0, True), (0.5, 20.0, False), (0.0, 30.0, False),
     (0.0, 7.5, False)],
)  # fmt: skip
def test_whole_times_with_round_steps_are_milliseconds_also_of_a_stationary_car(first, period, recognised):
    rows = milliseconds(0.0, [2.0] * 60, period, first)
    rows.t[3] = np.nan
    assert bool(other_units(rows, CAR, native_map(CAR))[1]) is recognised


@pytest.mark.parametrize(
    ("usual", "seldom", "recognised"),
    [(50.0, 50.0, True), (100.0, 100.0, True), (2.0, 2.0, True), (1.25, 1.25, False), (0.5, 50.0, False),
     (150.0, 150.0, False), (0.5, 0.5, False)],
)  # fmt: skip
def test_a_command_is_percent_where_it_is_often_above_1_and_never_above_100(usual, seldom, recognised):
    """Ten of a hundred rows have the seldom value."""
    values = np.where(np.arange(100) % 10 == 0, seldom, usual) * np.where(np.arange(100) % 2, 1.0, -1.0)
    rows = RawRows(0.05 * np.arange(100), np.zeros((100, 4)), np.column_stack([values, np.zeros(100)]))
    found = other_units(rows, CAR_THROTTLE, native_map(CAR_THROTTLE))[1]
    assert [one.message.startswith(f"{CAR_THROTTLE.action_names[0]} reaches") for one in found] == [True] * recognised


def test_an_angle_without_commands_is_not_judged() -> None:
    rows = car_rows(50)
    rows.actions[:, 1] = np.nan
    bad, findings = degrees_for_radians(rows, CAR)
    assert (bad.any(), findings) == (False, [])


@pytest.mark.parametrize(
    ("start", "done", "message"),
    [(None, "", "2 rows"), (12.3456, "", "2 rows, first at t = 12.346 s"), (NONE, "", "2 rows"),
     (float("inf"), "cut out", "2 rows; cut out"), (0.0, "cut out", "2 rows, first at t = 0.000 s; cut out")],
)  # fmt: skip
def test_a_finding_names_the_first_time_where_it_is_known(start: float | None, done: str, message: str) -> None:
    assert finding("kind", "2 rows", 2, start, done).message == message


@pytest.mark.parametrize("findings", [(), (Finding("comment_lines", "two lines were left out", 2),)])
def test_a_table_without_a_row_is_refused_with_the_findings(findings: tuple[Finding, ...]) -> None:
    columns = replace(native_map(CAR), tracked_point=TrackedPoint(ahead=0.1))
    rows, findings = mapped_rows(Table({name: np.empty(0) for name in columns.sources}, findings), columns, CAR)
    assert (len(rows.t), rows.actions.shape) == (0, (0, 2))
    with pytest.raises(RunError) as caught:
        run_of_rows(Path("a.csv"), CAR, columns, rows, findings)
    assert str(caught.value).startswith("a.csv: no rows")
    assert ("two lines were left out" in str(caught.value)) == bool(findings)


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
    table = Table({"a": np.array([3.0, 5.0, NONE, NONE]), "b": np.array([4.0, NONE, 2.0, NONE])}, ())
    np.testing.assert_array_equal(joined_column(table, SourceColumn("a", others=("b",), join=join)), found)
