"""Files that cannot be used are refused with one line each."""

from pathlib import Path

import numpy as np
import pyarrow
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from safedpa.errors import ColumnMapError, RunError
from safedpa.records import load_column_map, load_run
from safedpa.records.load import read_columns
from safedpa.robots.car.system import CAR
from safedpa.robots.pendulum.system import PENDULUM

HEADER = "t,x,y,yaw,speed,target_speed,steer"


def line(row: int) -> str:
    t = 0.05 * row
    x, y = np.sin(t), 1 - np.cos(t)
    values = (t, x, y, t, 1.0 + 0.01 * np.sin(3 * t), 1 + 0.1 * np.sin(t), 0.3 + 0.1 * np.cos(t))
    return ",".join(repr(float(value)) for value in values)


LINES = [line(row) for row in range(60)]


def write(path: Path, lines: list[str], header: str = HEADER, end: str = "\n") -> Path:
    path.write_text("\n".join([header, *lines]) + end)
    return path


def error_of(path: Path) -> str:
    with pytest.raises(RunError) as caught:
        load_run(path, CAR)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


def test_a_good_file_gives_its_numbers(tmp_path: Path) -> None:
    run = load_run(write(tmp_path / "drive.csv", LINES), CAR)
    assert run.findings == ()
    assert run.name == "drive"
    row = [float(cell) for cell in LINES[7].split(",")]
    np.testing.assert_array_equal([run.t[7], *run.states[7], *run.actions[7]], row)


@pytest.mark.parametrize("separator", [";", "\t"])
def test_other_separators_other_orders_and_more_columns_are_read(tmp_path: Path, separator: str) -> None:
    names = [*reversed(HEADER.split(",")), "note"]
    lines = [separator.join([*reversed(text.split(",")), "some text"]) for text in LINES]
    run = load_run(write(tmp_path / "drive.csv", lines, separator.join(names)), CAR)
    np.testing.assert_array_equal(run.t, [float(text.split(",")[0]) for text in LINES])


def test_a_byte_order_mark_and_windows_line_ends_are_read(tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join([HEADER, *LINES]).encode())
    assert len(load_run(path, CAR).t) == 60


def test_a_file_without_an_ending_is_known_by_its_content(tmp_path: Path) -> None:
    csv = write(tmp_path / "drive", LINES)
    run = load_run(csv, CAR)
    columns = dict(zip(HEADER.split(","), np.column_stack([run.t, run.states, run.actions]).T, strict=True))
    parquet.write_table(pyarrow.table(columns), tmp_path / "other")
    np.testing.assert_array_equal(load_run(tmp_path / "other", CAR).states, run.states)


def test_missing_empty_and_folder(tmp_path: Path) -> None:
    assert "no such file" in error_of(tmp_path / "nothing.csv")
    (tmp_path / "empty.csv").touch()
    assert "the file is empty" in error_of(tmp_path / "empty.csv")
    assert "is a folder" in error_of(tmp_path)
    assert "no rows" in error_of(write(tmp_path / "header.csv", [], end=""))
    assert "no rows" in error_of(write(tmp_path / "header2.csv", []))


def test_a_missing_column_names_the_nearest(tmp_path: Path) -> None:
    path = write(tmp_path / "drive.csv", LINES, HEADER.replace("steer", "steering"))
    message = error_of(path)
    assert "column 'steer' is missing; did you mean 'steering'? known: speed, steering, t, target_speed" in message
    assert "column map" in message


@settings(max_examples=30, deadline=None)
@given(row=st.integers(0, 59), column=st.integers(0, 6), text=st.sampled_from(["abc", "1,5x", "1.2.3", "1-2", "0x10"]))
def test_text_for_a_number_is_named_by_line_and_column(tmp_path_factory, row, column, text):
    text = text.replace(",", "")
    cells = [entry.split(",") for entry in LINES]
    cells[row][column] = text
    path = write(tmp_path_factory.mktemp("text") / "drive.csv", [",".join(entry) for entry in cells])
    name = HEADER.split(",")[column]
    assert f"line {row + 2}, column '{name}': got '{text}', wanted a number" in error_of(path)


@settings(max_examples=40, deadline=None)
@given(keep=st.integers(1, len(LINES[-1])))
def test_a_last_line_that_was_cut_off_loses_that_line_alone(tmp_path_factory: pytest.TempPathFactory, keep: int):
    """A number that was cut off within its digits cannot be distinguished from a whole one: then the line may stay."""
    path = write(tmp_path_factory.mktemp("cut") / "drive.csv", [*LINES[:-1], LINES[-1][:keep]], end="")
    run = load_run(path, CAR)
    cells = LINES[-1][:keep].split(",")
    np.testing.assert_array_equal(run.states[:59, 0], [float(text.split(",")[1]) for text in LINES[:-1]])
    if len(cells) < 7:
        assert [finding.kind for finding in run.findings] == ["malformed_line"]
        assert "first line 61; dropped" in run.findings[0].message
        assert len(run.t) == 59


@pytest.mark.parametrize(
    ("last", "end", "kept"), [("1.2", "", 59), ("1.2", "\n", 60), ("1.25", "", 60), ("1.2x", "", 59)]
)
def test_a_last_cell_that_is_shorter_than_those_above_it_and_has_no_line_end_is_reported(last, end, kept, tmp_path):
    lines = [f"{row},1.25" for row in range(59)] + [f"59,{last}"]
    table = read_columns(write(tmp_path / "a.csv", lines, "t,x", end=end), ["t", "x"])
    assert len(table) == kept
    assert len(table.findings) == 60 - kept


def test_empty_cells_are_missing_values_and_cut(tmp_path: Path) -> None:
    cells = LINES[30].split(",")
    cells[2] = ""
    run = load_run(write(tmp_path / "drive.csv", [*LINES[:30], ",".join(cells), *LINES[31:]]), CAR)
    assert [finding.kind for finding in run.findings] == ["not_a_number", "cut"]
    assert [len(part) for part in run.stretches] == [30, 29]


def test_binary_content_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    path.write_bytes(bytes(range(128, 256)) * 20)
    assert "is not text" in error_of(path)
    path = tmp_path / "drive.parquet"
    path.write_bytes(b"PAR1" + bytes(50))
    assert "cut off after 54 bytes" in error_of(path)
    path = tmp_path / "drive.mcap"
    path.write_bytes(b"PAR1" + bytes(50))
    assert "is no MCAP file" in error_of(path)


def test_a_map_whose_column_is_missing_names_it(tmp_path: Path) -> None:
    path = write(tmp_path / "drive.csv", LINES)
    with pytest.raises(RunError, match=r"column 'time' is missing \(and 3 more: position, torque\b.*|column 'time'"):
        load_run(path, PENDULUM, load_column_map("dfki_pendulum_columns"))
    with pytest.raises(ColumnMapError, match=r"the map is for a pendulum, the model for a car"):
        load_run(path, CAR, load_column_map("dfki_pendulum_columns.toml"))
