"""Column maps made by a form: guesses, the text that is written, and what the preview says."""

import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.records.ros_logs import bag

from safedpa.errors import ColumnMapError, RunError
from safedpa.records import load_column_map
from safedpa.records.column_map.column_map import native_map
from safedpa.records.column_map.file import parse_column_map, shipped_column_maps
from safedpa.records.column_map.form import DERIVED, QuantityForm, guess_columns, lines_of, map_text, units_for
from safedpa.records.readers.preview import raw_rows
from safedpa.robots.car.system import CAR
from safedpa.systems import systems
from safedpa_services.workbench.open_dialog.file_preview import check_recording
from safedpa_services.workbench.session.inputs import EditedColumnMap

NUMBERS = st.floats(-1e6, 1e6).filter(bool)


def test_names_with_units_are_guessed(plain):
    header = ["Timestamp [ms]", "pos_x", "pos_y", "heading_deg", "velocity", "gas", "steering angle [deg]", "battery"]
    found = {line.target: line for line in guess_columns(plain.system, header)}
    assert {target: line.source for target, line in found.items()} == {
        "t": "Timestamp [ms]", "x": "pos_x", "y": "pos_y", "yaw": "heading_deg", "speed": "velocity",
        "throttle": "gas", "steer": "steering angle [deg]",
    }  # fmt: skip
    assert (found["t"].unit, found["yaw"].unit, found["steer"].unit, found["x"].unit) == ("ms", "deg", "deg", "")


def test_native_names_are_guessed_as_they_are(plain):
    header = ["t", "x", "y", "yaw", "speed", "throttle", "steer"]
    assert (
        EditedColumnMap(map_text(plain.system, guess_columns(plain.system, header))).columns.columns
        == native_map(plain.system).columns
    )


def test_a_speed_that_the_log_lacks_is_derived(plain):
    found = {line.target: line for line in guess_columns(plain.system, ["time", "x", "y", "yaw", "throttle", "steer"])}
    assert found["speed"].source == DERIVED
    assert found["yaw"].derivation == ""


def test_no_column_is_guessed_twice():
    lines = guess_columns(systems()["pendulum"], ["time", "position", "velocity", "torque"])
    sources = [line.source for line in lines]
    assert sources == ["time", "position", "velocity", "torque"]


@pytest.mark.parametrize("name", sorted(shipped_column_maps()))
def test_a_map_that_ships_comes_back_from_the_form(name, plain):
    columns = load_column_map(name)
    known = [plain.system, *systems().values()]
    system = next(one for one in known if one.name == columns.robot and set(one.action_names) <= set(columns.columns))
    assert EditedColumnMap(map_text(system, lines_of(system, columns)), name).columns == columns


@settings(max_examples=40)
@given(
    source=st.text(min_size=1, max_size=12).filter(lambda text: text not in ("y", DERIVED)),
    scale=NUMBERS,
    offset=NUMBERS,
    flip=st.booleans(),
    unit=st.sampled_from(units_for("m")),
)
def test_what_is_written_is_read_again(source, scale, offset, flip, unit):
    system = systems()["point"]
    lines = [QuantityForm("x", "m", source, unit, scale, offset, flip), QuantityForm("y", "m", "y")]
    column = parse_column_map(map_text(system, lines)).columns["x"]
    assert (column.source, column.scale, column.offset, column.flip) == (source, scale, offset, flip)
    assert (column.unit or "m") == unit


def test_one_column_for_two_quantities_is_refused(plain):
    lines = [QuantityForm("x", "m", "a"), QuantityForm("y", "m", "a")]
    made = EditedColumnMap(map_text(plain.system, lines))
    with pytest.raises(ColumnMapError, match="already the source"):
        assert made.columns


def test_the_preview_is_in_si_units_and_names_what_is_wrong(plain, drives, tmp_path):
    native = raw_rows(drives[1][0], 3)
    assert native.names == ("t", "x", "y", "yaw", "speed", "throttle", "steer")
    assert len(native.rows) == 3
    foreign = tmp_path / "foreign.csv"
    header = "time;x;y;yaw deg;speed;throttle;steer\n"
    rows = [f"{0.05 * k};{0.05 * k};0;{90 + 0.01 * k};1;0.1;0\n" for k in range(100)]
    foreign.write_text(header + "".join(rows), encoding="utf-8")
    columns = EditedColumnMap(map_text(plain.system, guess_columns(plain.system, raw_rows(foreign).names))).columns
    found = check_recording(foreign, plain.system, columns)
    assert found.problem == ""
    assert "100 rows in 1 stretch" in found.sentence
    assert found.rows[0][3] == pytest.approx(math.pi / 2)
    assert any("turned by -90 degrees against yaw" in message for message in found.findings)
    assert "column 't' is missing" in check_recording(foreign, plain.system, None).problem


def test_files_that_cannot_be_previewed_are_refused_in_one_line(tmp_path):
    empty = tmp_path / "empty.csv"
    empty.write_text("\n", encoding="utf-8")
    with pytest.raises(RunError, match="first line is empty"):
        raw_rows(empty)
    with pytest.raises(RunError, match="no such file"):
        raw_rows(tmp_path / "none.csv")
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\xff\xfe\x00\x01" * 50)
    with pytest.raises(RunError, match="cannot be read"):
        raw_rows(binary)


def test_the_fields_of_a_bag_s_topics_are_guessed_and_the_map_reads_it(tmp_path: Path) -> None:
    path = next(bag(tmp_path / "drive", "mcap", 100).glob("*.mcap"))
    names = raw_rows(path).names
    assert "/odom:@header" in names
    lines = guess_columns(CAR, names)
    assert lines[0].source == "/odom:@header"
    columns = parse_column_map(map_text(CAR, lines))
    found = check_recording(path, CAR, columns)
    assert not found.problem
    assert "100 rows in 1 stretch" in found.sentence
    shipped = load_column_map("f1tenth_bag")
    assert set(shipped.sources) <= set(names)
    again = parse_column_map(map_text(CAR, lines_of(CAR, shipped)))
    assert dict(again.columns) == dict(shipped.columns)


def test_an_edited_map_has_its_columns_and_the_rest_of_the_map_it_began_with() -> None:
    base = load_column_map("dart_car_columns")
    native = native_map(CAR)
    edited = EditedColumnMap(map_text(CAR, lines_of(CAR, native)), "dart_car_columns").columns
    assert edited.columns == native.columns
    assert edited.columns != base.columns
    assert (edited.tracked_point, edited.keep) == (base.tracked_point, base.keep)
