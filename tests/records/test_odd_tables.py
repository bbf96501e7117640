"""Tables as people bring them: stray quotation marks, other encodings, decimal commas, blank lines, nanoseconds."""

import io
import os
import subprocess
import threading
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from safedpa.errors import RunError
from safedpa.limits import LimitError
from safedpa.records import Run, load_run
from safedpa.records.column_map.file import parse_column_map
from safedpa.robots.car.system import CAR

HEADER = "t,x,y,yaw,speed,target_speed,steer"
NAMES = HEADER.split(",")


def row(number: int) -> list[float]:
    t = 0.05 * number
    speed = 1.0 + 0.01 * np.sin(3 * t)
    return [t, np.sin(t), 1 - np.cos(t), t, speed, 1 + 0.1 * np.sin(t), 0.3 + 0.1 * np.cos(t)]


ROWS = [row(number) for number in range(100)]
LINES = [",".join(repr(float(value)) for value in values) for values in ROWS]
GERMAN = [line.replace(",", ";").replace(".", ",") for line in LINES]


def written(path: Path, lines: list[str] | list[bytes], end: str = "\n") -> Path:
    path.write_bytes(end.encode().join(line if isinstance(line, bytes) else line.encode() for line in lines))
    return path


def error_of(path: Path) -> str:
    with pytest.raises(RunError) as caught:
        load_run(path, CAR)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@settings(max_examples=60, deadline=None)
@given(
    cells=st.lists(st.tuples(st.integers(0, 99), st.integers(0, 6)), min_size=1, max_size=120),
    exponent=st.integers(20, 308),
    sign=st.sampled_from(["", "-"]),
)
def test_a_number_of_any_size_is_cut_or_refused(
    cells: list[tuple[int, int]], exponent: int, sign: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Sums and squares of such numbers overflow; the suite raises each warning as an error."""
    rows = [[repr(float(value)) for value in values] for values in ROWS]
    for at, column in cells:
        rows[at][column] = f"{sign}9e{exponent}"
    path = written(tmp_path_factory.mktemp("table") / "drive.csv", [HEADER, *(",".join(cell) for cell in rows)])
    try:
        run = load_run(path, CAR)
    except RunError:
        return
    assert all(np.abs(run.states[part.start : part.stop]).max() < 1e3 for part in run.stretches)
    assert run.findings


@pytest.mark.parametrize("last", [99, 60])
def test_a_quotation_mark_that_is_never_closed_loses_no_rows_in_silence(tmp_path: Path, last: int) -> None:
    """The reader takes all that follows, up to the next mark or the end, for one cell of a column that is not read."""
    notes = ['"left' if number in (40, last) else "right" for number in range(100)]
    lines = [f"{line},{note}" for line, note in zip(LINES, notes, strict=True)]
    text = error_of(written(tmp_path / "drive.csv", [f"{HEADER},note", *lines]))
    assert "line 42: a quotation mark opens there" in text
    assert "remove the line" in text


def test_a_stray_quotation_mark_at_the_beginning_of_a_line_is_reported(tmp_path: Path) -> None:
    text = error_of(written(tmp_path / "drive.csv", [HEADER, *LINES[:40], f'"{LINES[40]}', *LINES[41:]]))
    assert "line 42: a quotation mark opens there" in text


@pytest.mark.parametrize("note", ['"one, two\nthree"', '"one\n\n""two"" three"', '5" wheel', '"left"'])
def test_notes_with_quotation_marks_are_let_by(tmp_path: Path, note: str) -> None:
    lines = [f"{line},{note if number in (40, 60) else 'right'}" for number, line in enumerate(LINES)]
    assert len(load_run(written(tmp_path / "drive.csv", [f"{HEADER},note", *lines]), CAR).t) == 100


@pytest.mark.parametrize("at", [30, 90])
def test_a_note_in_a_windows_encoding_is_read_in_any_line(tmp_path: Path, at: int) -> None:
    lines = [f"{line},{'90°' if number == at else 'on'}".encode("cp1252") for number, line in enumerate(LINES)]
    assert len(load_run(written(tmp_path / "drive.csv", [f"{HEADER},note [°]".encode("cp1252"), *lines]), CAR).t) == 100


def test_long_lines_of_text_are_no_damage(tmp_path: Path) -> None:
    """The piece in which the header is looked for may end within a letter."""
    for letters in (1100, 1101):
        lines = [f"{line},{'é' * letters}" for line in LINES]
        assert len(load_run(written(tmp_path / "drive.csv", [f"{HEADER},note", *lines]), CAR).t) == 100


def test_a_line_of_rubbish_costs_that_line_alone(tmp_path: Path) -> None:
    lines = [line.encode() for line in LINES]
    run = load_run(written(tmp_path / "drive.csv", [HEADER.encode(), *lines[:40], b"\xff\xfe,1", *lines[40:]]), CAR)
    assert [finding.kind for finding in run.findings] == ["malformed_line"]
    assert "first line 42" in run.findings[0].message
    assert len(run.t) == 100


@pytest.mark.parametrize("before", [0, 2])
def test_lines_are_counted_as_an_editor_counts_them(tmp_path: Path, before: int) -> None:
    lines = [*["# a note"] * before, HEADER, *LINES[:20], "", "", "1,2", *LINES[20:]]
    run = load_run(written(tmp_path / "drive.csv", lines), CAR)
    assert f"first line {24 + before}" in next(item.message for item in run.findings if item.kind == "malformed_line")
    lines[-1] = lines[-1].replace(",", ",x", 1)
    assert f"line {104 + before}, column 'x': got 'x" in error_of(written(tmp_path / "bad.csv", [*lines, ""]))


def test_a_column_of_dates_does_not_hide_decimal_commas(tmp_path: Path) -> None:
    lines = ["date;" + HEADER.replace(",", ";"), *(f"27.11.2026 10:00:00;{line}" for line in GERMAN)]
    run = load_run(written(tmp_path / "drive.csv", lines), CAR)
    np.testing.assert_allclose(run.states[:, 0], [values[1] for values in ROWS], atol=0)
    lines[3] = lines[3].replace(",", ".", 2)
    assert "wanted a number with a decimal comma" in error_of(written(tmp_path / "point.csv", lines))


@pytest.mark.parametrize("kind", ["int64", "uint64"])
def test_parquet_with_whole_nanoseconds_since_1970_is_read(tmp_path: Path, kind: str) -> None:
    columns = {name: np.array([values[index] for values in ROWS]) for index, name in enumerate(NAMES)}
    stamps = np.round(columns["t"] * 1e9).astype(kind) + np.array(1_700_000_000_123_456_789, kind)
    parquet.write_table(pyarrow.table({**columns, "t": stamps}), tmp_path / "drive.parquet")
    lines = "\n".join(f'{name} = "{name}"' for name in NAMES[1:])
    text = f'format = 1\nrobot = "car"\n[columns]\nt = {{ from = "t", unit = "ns" }}\n{lines}\n'
    run = load_run(tmp_path / "drive.parquet", CAR, parse_column_map(text))
    np.testing.assert_allclose(run.t - run.t[0], columns["t"], atol=1e-6)


def shifted(path: Path, rows: list[list[float]], target: str, more: str) -> Run:
    lines = [f'{name} = {{ from = "{name}"{more if name == target else ""} }}' for name in NAMES]
    text = "\n".join(['format = 1\nrobot = "car"\n[columns]', *lines])
    written(path, [HEADER, *(",".join(repr(float(value)) for value in values) for values in rows)])
    return load_run(path, CAR, parse_column_map(text))


def test_a_shift_mixes_no_two_parts_of_a_log_whose_clock_began_again(tmp_path: Path) -> None:
    other = [[values[0], values[1] + 50.0, *values[2:4], 2.0 + values[4], *values[5:]] for values in ROWS]
    run = shifted(tmp_path / "drive.csv", [*ROWS, *other], "speed", ", shift = 0.1")
    first, second = (states[:, 3] for _, states, _ in run.parts())
    np.testing.assert_allclose(first, [values[4] for values in ROWS[2:]], atol=1e-9)
    np.testing.assert_allclose(second, first + 2.0, atol=1e-9)


def test_a_shift_makes_no_values_within_a_gap(tmp_path: Path) -> None:
    late = [[*values[:4], 2.0 + values[4], *values[5:]] for values in ROWS[60:]]
    run = shifted(tmp_path / "drive.csv", [*ROWS[:40], *late], "speed", ", shift = 0.1")
    speeds = np.concatenate([states[:, 3] for _, states, _ in run.parts()])
    assert not ((speeds > 1.02) & (speeds < 2.98)).any()
    assert [len(part) for part in run.stretches] == [38, 38]


@pytest.mark.parametrize("whole", [2 * np.pi, 360.0])
def test_a_shifted_angle_goes_the_short_way_round(tmp_path: Path, whole: float) -> None:
    every = [row(number) for number in range(200)]
    rows = [[t, x, y, yaw * whole / (2 * np.pi) % whole, *rest] for t, x, y, yaw, *rest in every]
    unit = ', unit = "deg"' if whole == 360.0 else ""
    run = shifted(tmp_path / "drive.csv", rows, "yaw", f"{unit}, shift = 0.02")
    np.testing.assert_allclose(run.states[:, 2], run.t + 0.02, atol=1e-6)
    assert [len(part) for part in run.stretches] == [199]


def test_a_named_pipe_and_standard_input_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = written(tmp_path / "drive.csv", [HEADER, *LINES]).read_bytes()
    os.mkfifo(tmp_path / "pipe.csv")
    writer = threading.Thread(target=(tmp_path / "pipe.csv").write_bytes, args=(content,))
    writer.start()
    piped = load_run(tmp_path / "pipe.csv", CAR)
    writer.join()
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(content)))
    read = load_run("-", CAR)
    assert (piped.name, read.name, len(piped.t), len(read.t)) == ("pipe", "stdin", 100, 100)
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b"t,x\n0,1\n")))
    with pytest.raises(RunError, match=r"^-: column 'y' is missing"):
        load_run("-", CAR)


def test_an_endless_pipe_is_refused_within_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SAFEDPA_LIMITS", "piped_bytes=3000000")
    name = tmp_path / "end\nless.csv"
    os.mkfifo(name)
    with subprocess.Popen(["sh", "-c", 'exec cat /dev/zero > "$0"', name], stderr=subprocess.DEVNULL) as writer:
        with pytest.raises(LimitError, match=r"end\\x0aless.csv: bytes from a pipe.*wanted at most 3000000"):
            load_run(name, CAR)
        assert writer.wait(60) != 0  # nothing reads on


def test_the_error_for_a_name_with_a_line_break_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "a\nb.csv").write_text("t,x\n0,1\n", encoding="utf-8")
    for name in ("a\nb.csv", "missing\n\x1b[31m.csv"):
        with pytest.raises(RunError) as caught:
            load_run(tmp_path / name, CAR)
        assert str(caught.value).isprintable()


def two_rates(path: Path, hold: str) -> Run:
    """A row for each state, and one 5 ms before every fourth with the command alone."""
    lines = []
    for number, values in enumerate(ROWS):
        t, *states, target, steer = map(repr, map(float, values))
        lines += [f"{float(t) - 0.005},,,,,{target},{steer}"] if number % 4 == 0 else []
        lines.append(",".join([t, *states, "", ""]))
    names = [f'{name} = {{ from = "{name}"{hold if name in NAMES[5:] else ""} }}' for name in NAMES]
    return load_run(
        written(path, [HEADER, *lines]),
        CAR,
        parse_column_map("\n".join(['format = 1\nrobot = "car"\n[columns]', *names])),
    )


@pytest.mark.parametrize(("hold", "rows"), [("", 100), (", hold = 0.3", 100), (", hold = 0.1", 50)])
def test_columns_of_another_rate_are_held(hold: str, rows: int, tmp_path: Path) -> None:
    """A command is 5, 55, 105 or 155 ms old; with a hold of 0.1 s two rows of four remain, too few in a row."""
    if rows < 100:
        with pytest.raises(RunError, match="no usable stretch"):
            two_rates(tmp_path / "drive.csv", hold)
        return
    run = two_rates(tmp_path / "drive.csv", hold)
    assert [item.count for item in run.findings if item.kind == "joined_rates"] == [25]
    assert run.actions[:, 0].tolist() == [ROWS[number - number % 4][5] for number in range(100)]
