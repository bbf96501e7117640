"""Tables just within and just beyond what their readers take: lengths, headers, columns, what a cell may be."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from safedpa.errors import ColumnMapError, RunError
from safedpa.limits import LimitError
from safedpa.records.csv_table import read_csv_table
from safedpa.records.parquet_table import read_parquet_table
from safedpa.records.table import require_columns, require_file
from safedpa.records.units import UNITS, factor_to_si


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "a.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


@pytest.mark.parametrize(
    ("text", "said"),
    [
        pytest.param("\n\n", "the first line is empty; wanted a header line with the columns' names", id="empty lines"),
        pytest.param("#\n#\n", "the first line is empty; wanted a header line", id="comments without a word"),
        pytest.param(b"t\0,x\n0,1\n", "the first line is no text; wanted a CSV file in UTF-8", id="a zero byte"),
        pytest.param("t,y\n0,1\n", "column 'x' is missing; .*rename it in the file, or name a column map", id="no x"),
        pytest.param("a,b\n0,1\n", r"column 't' is missing \(and 1 more: x\)", id="neither"),
        pytest.param("t,x,x\n0,1,2\n", "column 'x' is there 2 times; give each its own name", id="x twice"),
        pytest.param("t,x\n0,a\n1,2\n", "line 2, column 'x': got 'a', wanted a number; correct or remove", id="a word"),
        pytest.param("t,x\n0,1\n1,1_0\n2,3\n", "line 3, column 'x': got '1_0', wanted a number", id="an underscore"),
        pytest.param(
            "t,x\n0,1\n1,\u0661\n2,3\n", "line 3, column 'x': got '\u0661', wanted a number", id="other digits"
        ),
        pytest.param("t,x\n0,1\n1,0x10\n2,3\n", "line 3, column 'x': got '0x10', wanted a number", id="hexadecimal"),
        pytest.param(
            "t;x\n0,5;1,5\n1,5;1.500\n2,5;3\n",
            "column 'x': got '1.500', wanted a number|line 2, column 't': got '0,5'",
            id="a point among decimal commas",
        ),
        pytest.param(
            "t,x\n2026-11-27 10:00,1\n3,4\n", "column 't': got '2026-11-27 10:00', .*; write it as seconds", id="a date"
        ),
        pytest.param("t,x\n0,a\n1,2", "line 2, column 'x': got 'a', wanted a number", id="a word and no end of line"),
        pytest.param("t,x\n0,1\n1,a\n", "line 3, column 'x': got 'a', wanted a number", id="a word in the last line"),
        pytest.param(
            't,x,note\n0,1,a\n1,2,"left\n\n2,3,b\n3,4,c\n',
            "line 3: a quotation mark opens there",
            id="a blank line in it",
        ),
        pytest.param(
            't,x,note\n0,1,a\n1,2,"left\n2,3\n3,4,c\n', "line 3: a quotation mark opens there", id="a short line in it"
        ),
        pytest.param(
            "t,x\n0,05,1,25\n0,10,1,5\n0,15,2,0\n", "rows have twice as many cells as the header's 2", id="twice"
        ),
    ],
)
def test_a_table_that_cannot_be_used_is_refused_with_its_place(text: str | bytes, said: str, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=said):
        read_csv_table(written(tmp_path, text), ("t", "x"))


@pytest.mark.parametrize(
    ("text", "x", "kinds"),
    [
        pytest.param("t,x\n", [], [], id="no rows"),
        pytest.param("t,x\n\n \n", [], [], id="only blanks"),
        pytest.param("t,x\n0,1\n", [1.0], [], id="one row"),
        pytest.param("t,x\n0,1", [1.0], [], id="no end of line"),
        pytest.param("t,x\n0,1\n1,a", [1.0], ["malformed_line"], id="cut off within a number"),
        pytest.param("t,x\n0,1\n1\n2,3\n", [1.0, 3.0], ["malformed_line"], id="a cell too few"),
        pytest.param("t,x\n0,1\n1,2,3\n2,3\n", [1.0, 3.0], ["malformed_line"], id="a cell too many"),
        pytest.param("# a\n# b\nt,x\n0,1\n", [1.0], ["comment_lines"], id="comments before"),
        pytest.param("t;x\n0,5;1,5\n", [1.5], ["decimal_comma"], id="decimal commas"),
        pytest.param("t;x\n0,5;1,5\n1,5;a", [1.5], ["decimal_comma", "malformed_line"], id="commas, cut off"),
        pytest.param("t,x\n0,1.5\n1,a", [1.5], ["malformed_line"], id="points, cut off"),
        pytest.param('t,x,"note\n0,1,a\n1,2,b\n', [1.0, 2.0], [], id="a quotation mark that opens in the header"),
        pytest.param("# t,x\n0,1\n", [1.0], [], id="the header is a comment"),
        pytest.param("Drive of May 3\nt,x\n0,1\n", [1.0], ["comment_lines"], id="a title before the header"),
        pytest.param('t,x,note\n0,1,"one\ntwo\nthree"\n1,2,b\n', [1.0, 2.0], [], id="a note of three lines"),
        pytest.param('note,t,x\n"one\ntwo",0,1\nb,1,2\n', [1.0, 2.0], [], id="a note of two lines before the numbers"),
        pytest.param('# a,"b\nt,x\n\n0,1\n1,2\n', [1.0, 2.0], ["comment_lines"], id="a quotation mark in a comment"),
        pytest.param("t\tx\n0.5\t1.5\n", [1.5], [], id="tabs"),
        pytest.param("t;x\n0.5;1.5\n", [1.5], [], id="semicolons, points"),
        pytest.param("t,x,note\n0,1,a\n1,2,b\n", [1.0, 2.0], [], id="a column of words beside"),
        pytest.param("t,x\n0,05\n0,1\n", [5.0, 1.0], [], id="as many cells as the header"),
        pytest.param("t,x,y\n1,2,3\n1,2,3\n", [2.0, 2.0], [], id="whole numbers"),
    ],
)
def test_a_table_just_within_is_read_and_what_was_odd_is_told(
    text: str, x: list[float], kinds: list[str], tmp_path: Path
) -> None:
    found = read_csv_table(written(tmp_path, text), ("t", "x"))
    assert found.columns["x"].tolist() == x
    assert [one.kind for one in found.findings] == kinds


@pytest.mark.parametrize(("cell", "x"), [("1,5", 1.5), ("7", 7.0), ("1.5", None), ("1.234,5", None)])
def test_a_point_far_below_decimal_commas_may_separate_thousands(cell: str, x: float | None, tmp_path: Path) -> None:
    """The mark is told from the first sixty lines; a last line that is cut off makes the reader look at each cell."""
    rows = "".join(f"{row},5;{row},25\n" for row in range(70))
    path = written(tmp_path, f"t;x\n{rows}70,5;{cell}\n71,5;a")
    if x is None:
        with pytest.raises(RunError, match=f"line 72, column 'x': got '{cell}', wanted a number with a decimal comma"):
            read_csv_table(path, ("t", "x"))
    else:
        assert read_csv_table(path, ("t", "x")).columns["x"].tolist() == [*(row + 0.25 for row in range(70)), x]


@pytest.mark.parametrize("word", ["", "nan", "NaN", "NAN", "NA", "N/A", "null", "NULL", "None", "-nan"])
def test_what_stands_for_nothing_is_no_number_and_no_mistake(word: str, tmp_path: Path) -> None:
    """By the fast road, and by the slow one that a cut last line takes."""
    for end in ("2,3\n", "2,b"):
        found = read_csv_table(written(tmp_path, f"t,x\n0,1\n1,{word}\n{end}"), ("t", "x")).columns["x"]
        assert found[0] == 1.0
        assert np.isnan(found[1])


@pytest.mark.parametrize("more", [0, 1])
def test_a_first_line_is_so_long_at_most(more: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And many lines together may be longer."""
    monkeypatch.setenv("SAFEDPA_LIMITS", "header_bytes=100")
    head = "t,x," + "y" * (95 + more)
    assert len(head) == 99 + more
    path = written(tmp_path, f"{head}\n")
    if more:
        with pytest.raises(
            LimitError, match=r"more than 100 bytes in the first line, wanted at most 100; .*header_bytes"
        ):
            read_csv_table(written(tmp_path, f"{head}y"), ("t", "x"))
    else:
        assert len(read_csv_table(path, ("t", "x")).columns["t"]) == 0
    assert len(read_csv_table(written(tmp_path, "t,x\n" + "0,1\n" * 200), ("t", "x")).columns["t"]) == 200


@pytest.mark.parametrize("what", ["an empty file", "a folder", "none"])
def test_what_is_no_file_with_bytes_is_refused(what: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    said = {
        "an empty file": "the file is empty; wanted a recording",
        "a folder": "is a folder; ",
        "none": "no such file; ",
    }
    if what == "an empty file":
        path.touch()
    elif what == "a folder":
        path.mkdir()
    with pytest.raises(RunError, match=f"{path}: {said[what]}"):
        require_file(path)
    (tmp_path / "b.csv").write_bytes(b"t")
    require_file(tmp_path / "b.csv")


def test_columns_that_are_wanted_are_there_once() -> None:
    path = Path("a.csv")
    require_columns(path, (), [])
    require_columns(path, ("t",), ["t", "x", "x"])
    with pytest.raises(RunError, match=r"column 'x' is there 2 times"):
        require_columns(path, ("t", "x"), ["t", "x", "x"])
    with pytest.raises(RunError, match=r"column 'y' is missing; "):
        require_columns(path, ("t", "y"), ["t", "x"])
    with pytest.raises(RunError, match=r"column 'y' is missing \(and 2 more: z, a\); "):
        require_columns(path, ("y", "z", "t", "a"), ["t", "x"])


SI = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "in": 0.0254, "ft": 0.3048},
    "rad": {"rad": 1.0, "deg": 0.017453292519943295, "rev": 6.283185307179586},
    "m/s": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 0.2777777777777778, "mph": 0.44704},
    "rad/s": {"rad/s": 1.0, "deg/s": 0.017453292519943295, "rpm": 0.10471975511965977},
    "N m": {"N m": 1.0, "mN m": 1e-3, "N cm": 1e-2},
}


@pytest.mark.parametrize(
    ("wanted", "unit"), [(si, unit) for si, units in SI.items() for unit in units if unit in UNITS]
)
def test_a_unit_has_its_factor_and_measures_one_thing(wanted: str, unit: str) -> None:
    assert factor_to_si(unit, wanted, "key") == pytest.approx(SI[wanted][unit], rel=1e-14)
    other = "m" if wanted != "m" else "rad"
    with pytest.raises(ColumnMapError, match=rf"^key: got unit '{unit}', wanted one for {other}: {other}, "):
        factor_to_si(unit, other, "key")


def test_an_unknown_unit_is_refused() -> None:
    with pytest.raises(ColumnMapError, match=r"^columns.x.unit: unknown unit 'metre'; "):
        factor_to_si("metre", "m", "columns.x.unit")


def parquet_file(folder: Path, **columns: object) -> Path:
    path = folder / "a.parquet"
    parquet.write_table(pa.table(columns), path)
    return path


@pytest.mark.parametrize("more", [0, 1])
def test_a_parquet_file_s_description_has_so_many_bytes(
    more: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = parquet_file(tmp_path, t=[0.0, 1.0], x=[2.0, 3.0])
    footer = struct.unpack("<I", path.read_bytes()[-8:-4])[0]
    monkeypatch.setenv("SAFEDPA_LIMITS", f"parquet_footer_bytes={footer - more}")
    if more:
        with pytest.raises(
            LimitError, match=f"got {footer} bytes, wanted at most {footer - 1}; .*parquet_footer_bytes"
        ):
            read_parquet_table(path, ("t", "x"))
    else:
        assert read_parquet_table(path, ("t", "x")).columns["x"].tolist() == [2.0, 3.0]


@pytest.mark.parametrize(
    ("values", "x"),
    [
        ([1, 2], [1.0, 2.0]),
        ([True, False], [1.0, 0.0]),
        ([1.5, None], [1.5, float("nan")]),
        (pa.array([1.5, 2.5], pa.float32()), [1.5, 2.5]),
        (["a", "b"], None),
        ([b"a", b"b"], None),
        ([[1.0], [2.0]], None),
        (pa.array([1, 2], pa.timestamp("s")), None),
    ],
)
def test_a_column_of_a_parquet_file_holds_numbers(values: object, x: list[float] | None, tmp_path: Path) -> None:
    path = parquet_file(tmp_path, t=[0.0, 1.0], x=values)
    if x is None:
        with pytest.raises(RunError, match=r"column 'x': got .*, wanted numbers"):
            read_parquet_table(path, ("t", "x"))
        assert read_parquet_table(path, ("t",)).columns["t"].tolist() == [0.0, 1.0]
    else:
        assert np.array_equal(read_parquet_table(path, ("t", "x")).columns["x"], x, equal_nan=True)


def test_a_parquet_file_may_not_become_far_more_than_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """100,000 equal numbers: 800,000 bytes of a file of some hundred."""
    path = parquet_file(tmp_path, t=np.zeros(100_000))
    monkeypatch.setenv("SAFEDPA_LIMITS", "expansion=1,expansion_free_bytes=2000000")
    assert len(read_parquet_table(path, ("t",)).columns["t"]) == 100_000
    monkeypatch.setenv("SAFEDPA_LIMITS", "expansion=1,expansion_free_bytes=700000")
    with pytest.raises(LimitError, match=r"expansion"):
        read_parquet_table(path, ("t",))


def test_a_parquet_file_that_says_to_have_less_than_no_rows_is_refused(tmp_path: Path) -> None:
    """3 is written as 6 and -3 as 5, behind the mark of the field: what is counted from it would pass any limit."""
    path = parquet_file(tmp_path, t=[0.0, 1.0, 2.0], x=[1.0, 2.0, 3.0])
    content = path.read_bytes()
    footer = len(content) - 8 - struct.unpack("<I", content[-8:-4])[0]
    at = content.index(b"\x16\x06", footer)
    path.write_bytes(content[: at + 1] + b"\x05" + content[at + 2 :])
    assert parquet.read_metadata(path).num_rows == -3
    with pytest.raises(LimitError, match=r"expansion"):
        read_parquet_table(path, ("t", "x"))


def test_rows_of_commas_below_a_header_of_semicolons_are_no_decimal_commas(tmp_path: Path) -> None:
    """They have one cell where the header has two; nobody is told to save the file with other numbers."""
    found = read_csv_table(written(tmp_path, "t;x\n1,2,3,4\n5,6,7,8\n9,9,9,9\n"), ("x",))
    assert found.columns["x"].tolist() == []
    assert [(one.kind, one.count) for one in found.findings] == [("malformed_line", 3)]
