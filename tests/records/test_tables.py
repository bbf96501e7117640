"""CSV and Parquet tables: headers, separators, cells that are no numbers, and the limits."""

import gzip
import struct
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from safedpa.errors import RunError
from safedpa.limits import LimitError
from safedpa.records.readers.csv import read_csv_table
from safedpa.records.readers.parquet import read_parquet_table
from safedpa.records.readers.table import require_columns, require_file


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "a.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("\n\n", "the first line is empty; wanted a header line with the columns' names"),
        ("#\n#\n", "the first line is empty; wanted a header line"),
        (b"t\0,x\n0,1\n", "the first line is not text; wanted a CSV file in UTF-8"),
        ("t,x\n0,a\n1,2\n", "line 2, column 'x': got 'a', wanted a number; correct or remove"),
        ("t,x\n0,a\n1,2", "line 2, column 'x': got 'a', wanted a number"),
        ("t,x\n0,1\n1,a\n", "line 3, column 'x': got 'a', wanted a number"),
        ("t,x\n0,1\n1,1_0\n2,3\n", "line 3, column 'x': got '1_0', wanted a number"),
        ("t,x\n0,1\n1,\u0661\n2,3\n", "line 3, column 'x': got '\u0661', wanted a number"),
        ("t,x\n0,1\n1,0x10\n2,3\n", "line 3, column 'x': got '0x10', wanted a number"),
        ("t;x\n0,5;1,5\n1,5;1.500\n2,5;3\n", "column 'x': got '1.500', wanted a number|line 2, column 't': got '0,5'"),
        ("t,x\n2026-11-27 10:00,1\n3,4\n", "column 't': got '2026-11-27 10:00', .*; write it as seconds"),
        ('t,x,note\n0,1,a\n1,2,"left\n\n2,3,b\n3,4,c\n', "line 3: a quotation mark opens there"),
        ('t,x,note\n0,1,a\n1,2,"left\n2,3\n3,4,c\n', "line 3: a quotation mark opens there"),
        ("t,x\n0,05,1,25\n0,10,1,5\n0,15,2,0\n", "rows have twice as many cells as the header's 2"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused_with_the_line(text: str | bytes, problem: str, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=problem):
        read_csv_table(written(tmp_path, text), ("t", "x"))


BAD_LINE, COMMENT, COMMA = "malformed_line", "comment_lines", "decimal_comma"


@pytest.mark.parametrize(
    ("text", "x", "kinds"),
    [
        pytest.param("t,x\n", [], [], id="no rows"),
        pytest.param("t,x\n\n \n", [], [], id="only blanks"),
        pytest.param("t,x\n0,1", [1.0], [], id="no end of line"),
        pytest.param("t,x\n0,1\n1,a", [1.0], [BAD_LINE], id="cut off within a number"),
        pytest.param("t,x\n0,1\n1\n2,3\n", [1.0, 3.0], [BAD_LINE], id="a cell too few"),
        pytest.param("t,x\n0,1\n1,2,3\n2,3\n", [1.0, 3.0], [BAD_LINE], id="a cell too many"),
        pytest.param("# a\n# b\nt,x\n0,1\n", [1.0], [COMMENT], id="comments before"),
        pytest.param("# t,x\n0,1\n", [1.0], [], id="the header is a comment"),
        pytest.param("Drive of May 3\nt,x\n0,1\n", [1.0], [COMMENT], id="a title before the header"),
        pytest.param("t;x\n0,5;1,5\n", [1.5], [COMMA], id="decimal commas"),
        pytest.param("t;x\n0,5;1,5\n1,5;a", [1.5], [COMMA, BAD_LINE], id="commas, cut off"),
        pytest.param("t,x\n0,1.5\n1,a", [1.5], [BAD_LINE], id="points, cut off"),
        pytest.param("t\tx\n0.5\t1.5\n", [1.5], [], id="tabs"),
        pytest.param("t;x\n0.5;1.5\n", [1.5], [], id="semicolons, points"),
        pytest.param('t,x,"note\n0,1,a\n1,2,b\n', [1.0, 2.0], [], id="a quotation mark that opens in the header"),
        pytest.param('t,x,note\n0,1,"one\ntwo\nthree"\n1,2,b\n', [1.0, 2.0], [], id="a note of three lines"),
        pytest.param('note,t,x\n"one\ntwo",0,1\nb,1,2\n', [1.0, 2.0], [], id="a note before the numbers"),
        pytest.param('# a,"b\nt,x\n\n0,1\n1,2\n', [1.0, 2.0], [COMMENT], id="a quotation mark in a comment"),
        pytest.param("t,x,note\n0,1,a\n1,2,b\n", [1.0, 2.0], [], id="a column of words"),
        pytest.param("t,x\n0,05\n0,1\n", [5.0, 1.0], [], id="as many cells as the header"),
        pytest.param('"t";"x";"a, b"\n0;1;2\n', [1.0], [], id="a name with a comma between semicolons"),
        pytest.param('t,x\n"0,5","1,5"\n', [1.5], [COMMA], id="quoted decimal commas between commas"),
        pytest.param(
            "t;x\n" + "0;1\n" * 99 + "1,5;2,5\n" + "2;3\n" * 99,
            [1.0] * 99 + [2.5] + [3.0] * 99,
            [COMMA],
            id="one decimal comma",
        ),
        pytest.param("t,x\n0,1,\n1,2,\n", [1.0, 2.0], [], id="a delimiter at the end of rows"),
        pytest.param("t,x,\n0,1\n1,2\n", [1.0, 2.0], [], id="a delimiter at the end of the header"),
        pytest.param(" t , x \n0, 1\n", [1.0], [], id="blanks around names"),
        pytest.param("t|x\n0|1\n", [1.0], [], id="pipes"),
        pytest.param("  t    x\n  0  1.5\n 10  2.5 \n", [1.5, 2.5], [], id="columns of blanks"),
        pytest.param("s t,x\ns,m\n0,1\n".replace("s t", "t"), [1.0], [COMMENT], id="a line of units"),
        pytest.param("t,x\n0,1\nt,x\n0,2\n1,3\n", [1.0, 2.0, 3.0], [BAD_LINE], id="the header again"),
        pytest.param("t,x\n0,True\n1,FALSE\n", [1.0, 0.0], [], id="booleans"),
        pytest.param("t,x\n2026-03-29T00:00:00Z,1\n2026-03-29 01:00:01+01:00,2\n", [1.0, 2.0], [], id="dates"),
        pytest.param(b"\xef\xbb\xbft,x\r\n0,1\r\n", [1.0], [], id="a byte order mark"),
        pytest.param("t,x\n0,1\n".encode("utf-16"), [1.0], [], id="UTF-16"),
        pytest.param("t,x\n0,1\n".encode("utf-16-be"), [1.0], [], id="UTF-16 without a mark"),
        pytest.param(gzip.compress(b"t,x\n0,1\n"), [1.0], [], id="gzip"),
    ],
)
def test_a_readable_table_gives_its_numbers_and_findings(
    text: str | bytes, x: list[float], kinds: list[str], tmp_path: Path
) -> None:
    found = read_csv_table(written(tmp_path, text), ("t", "x"))
    assert found.columns["x"].tolist() == x
    assert [one.kind for one in found.findings] == kinds


def test_rows_of_commas_below_a_header_of_semicolons_are_malformed(tmp_path: Path) -> None:
    """They have one cell where the header has two; they are no decimal commas."""
    found = read_csv_table(written(tmp_path, "t;x\n1,2,3,4\n5,6,7,8\n9,9,9,9\n"), ("t", "x"))
    assert found.columns["x"].tolist() == []
    assert [(one.kind, one.count) for one in found.findings] == [(BAD_LINE, 3)]


@pytest.mark.parametrize(("cell", "x"), [("1,5", 1.5), ("7", 7.0), ("1.5", None), ("1.234,5", None)])
def test_a_point_far_below_decimal_commas_is_refused(cell: str, x: float | None, tmp_path: Path) -> None:
    """The separator is known from the first sixty lines; a last line that was cut off makes the reader check each."""
    rows = "".join(f"{row},5;{row},25\n" for row in range(70))
    path = written(tmp_path, f"t;x\n{rows}70,5;{cell}\n71,5;a")
    if x is None:
        with pytest.raises(RunError, match=f"line 72, column 'x': got '{cell}', wanted a number with a decimal comma"):
            read_csv_table(path, ("t", "x"))
    else:
        assert read_csv_table(path, ("t", "x")).columns["x"].tolist() == [*(row + 0.25 for row in range(70)), x]


@pytest.mark.parametrize(
    ("cells", "t"),
    [
        (["2026-03-29T00:59:50+00:00", "2026-03-29T02:59:51.5+02:00"], [1_774_745_990.0, 1_774_745_991.5]),
        (["29.03.2026 00:59:50", "29.03.2026 00:59:50,5"], [1_774_745_990.0, 1_774_745_990.5]),
        (["2026/03/29 00:59:50", ""], [1_774_745_990.0, float("nan")]),
        (["23:59:59.5", "0:00:01"], [86_399.5, 86_401.0]),
    ],
)
def test_dates_are_seconds_since_1970_and_times_of_day_continue_past_midnight(cells, t, tmp_path: Path) -> None:
    rows = "".join(f'"{cell}",{row}\n' for row, cell in enumerate(cells))
    found = read_csv_table(written(tmp_path, f"t,x\n{rows}"), ("t", "x"))
    np.testing.assert_array_equal(found.columns["t"], t)
    assert found.timed == {"t"}


def test_markers_of_missing_values_are_reported_by_column(tmp_path: Path) -> None:
    found = read_csv_table(written(tmp_path, "t,x,y\n0,#N/A,--\n1,1.#QNAN,2\n2,3,?\n"), ("t", "x", "y"))
    assert np.isnan(found.columns["x"]).tolist() == [True, True, False]
    assert [one.message for one in found.findings] == [
        "x: 2 cells hold '#N/A', '1.#QNAN'; read as missing values",
        "y: 2 cells hold '--', '?'; read as missing values",
    ]


def test_an_element_of_a_list_is_a_column(tmp_path: Path) -> None:
    wanted = ("t", "state[1]", "state[0]")
    table = read_csv_table(written(tmp_path, 't,state\n0,"[1.5, 2.5]"\n1,"[3.5]"\n'), wanted)
    lists = read_parquet_table(parquet_file(tmp_path, t=[0.0, 1.0], state=[[1.5, 2.5], [3.5]]), wanted)
    for found in (table, lists):
        np.testing.assert_array_equal(found.columns["state[1]"], [2.5, np.nan])
        assert found.columns["state[0]"].tolist() == [1.5, 3.5]


def test_a_table_without_a_header_is_refused_as_such(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="has no header: line 1 holds numbers; write a first line"):
        read_csv_table(written(tmp_path, "0,1\n1,2\n"), ("t", "x"))


@pytest.mark.parametrize("word", ["", "nan", "NaN", "NAN", "NA", "N/A", "null", "NULL", "None", "-nan"])
@pytest.mark.parametrize("end", ["2,3\n", "2,b"])
def test_a_missing_value_is_not_a_number_and_no_mistake(word: str, end: str, tmp_path: Path) -> None:
    """Also where the last line is cut off, which another reader handles."""
    found = read_csv_table(written(tmp_path, f"t,x\n0,1\n1,{word}\n{end}"), ("t", "x")).columns["x"]
    assert found[0] == 1.0
    assert np.isnan(found[1])


def test_the_first_line_is_limited_and_the_others_are_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SAFEDPA_LIMITS", "header_bytes=100")
    assert len(read_csv_table(written(tmp_path, "t,x," + "y" * 95 + "\n"), ("t", "x")).columns["t"]) == 0
    with pytest.raises(LimitError, match=r"more than 100 bytes in the first line, wanted at most 100; .*header_bytes"):
        read_csv_table(written(tmp_path, "t,x," + "y" * 97), ("t", "x"))
    assert len(read_csv_table(written(tmp_path, "t,x\n" + "0,1\n" * 200), ("t", "x")).columns["t"]) == 200


def test_a_recording_is_a_file_with_bytes_and_each_column_once(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    (tmp_path / "full").write_bytes(b"t")
    require_file(tmp_path / "full")
    for name, problem in {"empty": "the file is empty", "none": "no such file", "": "is a folder"}.items():
        with pytest.raises(RunError, match=f"{tmp_path / name}: {problem}"):
            require_file(tmp_path / name)
    path = Path("a.csv")
    require_columns(path, ("t",), ["t", "x", "x"])
    for wanted, problem in {
        ("t", "x"): r"column 'x' occurs 2 times; rename the others",
        (
            "t",
            "y",
        ): r"column 'y' is missing; .*rename it in the file, or name a column map: 'safedpa columns a.csv' proposes",
        ("y", "z", "t", "a"): r"column 'y' is missing \(and 2 more: z, a\); ",
    }.items():
        with pytest.raises(RunError, match=problem):
            require_columns(path, wanted, ["t", "x", "x"])


def parquet_file(folder: Path, **columns: object) -> Path:
    path = folder / "a.parquet"
    parquet.write_table(pa.table(columns), path)
    return path


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
        (pa.array([1, 2], pa.timestamp("s")), [1.0, 2.0]),
        (pa.array([1_500, 2_500], pa.duration("ms")), [1.5, 2.5]),
        (pa.array([86_399_000, 1_000], pa.time32("ms")), [86_399.0, 86_401.0]),
        (pa.array(["1.5", "2.5"]).cast(pa.decimal128(5, 2)), [1.5, 2.5]),
        (pa.array(["1.5", "2,5"]).dictionary_encode(), None),
        (pa.array(["1.5", "#N/A"]), [1.5, float("nan")]),
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


def test_a_parquet_file_stays_within_its_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """100,000 equal numbers: 800,000 bytes of a file of some hundred."""
    path = parquet_file(tmp_path, t=np.zeros(100_000))
    footer = struct.unpack("<I", path.read_bytes()[-8:-4])[0]
    for limits in (f"parquet_footer_bytes={footer}", "expansion=1,expansion_free_bytes=2000000"):
        monkeypatch.setenv("SAFEDPA_LIMITS", limits)
        assert len(read_parquet_table(path, ("t",)).columns["t"]) == 100_000
    for limits, problem in {
        f"parquet_footer_bytes={footer - 1}": f"got {footer} bytes, wanted at most {footer - 1}; ",
        "expansion=1,expansion_free_bytes=700000": "expansion",
    }.items():
        monkeypatch.setenv("SAFEDPA_LIMITS", limits)
        with pytest.raises(LimitError, match=problem):
            read_parquet_table(path, ("t",))


def test_a_parquet_file_with_a_negative_number_of_rows_is_refused(tmp_path: Path) -> None:
    """3 is written as 6 and -3 as 5; a size that is computed from it would pass any limit."""
    path = parquet_file(tmp_path, t=[0.0, 1.0, 2.0], x=[1.0, 2.0, 3.0])
    content = path.read_bytes()
    footer = len(content) - 8 - struct.unpack("<I", content[-8:-4])[0]
    at = content.index(b"\x16\x06", footer)
    path.write_bytes(content[: at + 1] + b"\x05" + content[at + 2 :])
    assert parquet.read_metadata(path).num_rows == -3
    with pytest.raises(LimitError, match=r"expansion"):
        read_parquet_table(path, ("t", "x"))
