"""Reads CSV files as tables; an error names the line and column of the bad cell."""

from __future__ import annotations

import contextlib
import csv
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import RunError
from safedpa.limits import limit, readable, too_much
from safedpa.records.readers.table import Table, require_columns, require_file
from safedpa.records.run import Finding

if TYPE_CHECKING:
    import pyarrow

__all__ = ["read_csv_table"]

_DELIMITERS = ",;\t"
_NULLS = ["", "nan", "NaN", "NAN", "NA", "N/A", "null", "NULL", "None", "-nan"]
_READ_BYTES = 1 << 16
_MAX_HEADER_LINES = 60
"""The header is searched among so many first lines."""
_COMMENTS = ("#", "%", "//")
_DATE = re.compile(r"\s*\d{1,4}[-/.:]\d{1,2}[-/.:]\d")


def read_csv_table(path: Path, wanted: Sequence[str]) -> Table:
    """Reads the wanted columns of a CSV file with a header line, separated by commas, semicolons or tabs.

    Lines with too few or too many cells, and a last line that was cut off within a number, are dropped and reported.
    Raises RunError for a missing column, and for the first cell that is not a number, with its line and column.
    """
    import pyarrow

    require_file(path)
    if path.stat().st_size > limit("table_bytes"):
        raise too_much("table_bytes", f"{path.stat().st_size} bytes", str(path))
    layout = _layout(path, wanted)
    if len(layout.header) > limit("columns"):
        raise too_much("columns", len(layout.header), str(path))
    require_columns(path, wanted, layout.header)
    if not _has_rows(path, layout):
        return Table({name: np.empty(0) for name in wanted}, layout.findings)
    malformed: list[tuple[int, int]] = []
    try:
        columns = _numbers(_parse(path, wanted, layout, pyarrow.float64(), malformed), wanted)
    except pyarrow.ArrowInvalid:
        malformed.clear()
        columns = _numbers_from_text(path, _read_as_text(path, wanted, layout, malformed), wanted, malformed, layout)
    _check_quotes(path, layout, len(columns[wanted[0]]) + len(malformed))
    findings = (_malformed_finding(path, malformed, layout),) if malformed else ()
    return Table(columns, (*layout.findings, *findings))


@dataclass(frozen=True)
class _Layout:
    """Layout of a file: lines before the header, column names, delimiter, decimal mark and encoding."""

    before: int
    header: list[str]
    delimiter: str
    point: str
    findings: tuple[Finding, ...]
    encoding: str = "utf8"


def _layout(path: Path, wanted: Sequence[str]) -> _Layout:
    read = [_decoded(line) for line in _first_lines(path)]
    lines = [line or "" for line in read]
    before = _lines_before_header(lines, wanted)
    if read[0] is None:  # binary: no header can follow
        raise RunError(f"{path}: the first line is not text; wanted a CSV file in UTF-8 with a header line")
    text = lines[before].lstrip("".join(_COMMENTS)).strip() if before or _is_comment(lines[0]) else lines[0]
    if not text:
        raise RunError(f"{path}: the first line is empty; wanted a header line with the columns' names")
    delimiter = max(_DELIMITERS, key=text.count)
    header = _header_cells(path, text, delimiter)
    findings = []
    if before:
        notice = f"{before} {'line' if before == 1 else 'lines'} before the header were ignored as comments"
        findings.append(Finding("comment_lines", f"{notice}; the header is line {before + 1}", before))
    point = "." if delimiter == "," else _decimal_mark(lines[before + 1 :], header, delimiter, wanted)
    if point == ",":
        text = "numbers have decimal commas and were read so; other programs may want decimal points"
        findings.append(Finding("decimal_comma", text))
    elif delimiter == "," and _twice_as_many(lines[before + 1 :], len(header)):
        raise RunError(
            f"{path}: rows have twice as many cells as the header's {len(header)}: decimal commas in a file "
            "separated by commas; save it with decimal points, or with semicolons between the cells"
        )
    return _Layout(before, header, delimiter, point, tuple(findings))


def _decoded(line: bytes) -> str | None:
    """Decodes a line as UTF-8, else as Windows-1252 (a degree sign in a header); None if it is not text."""
    for encoding in ("utf-8-sig", "cp1252"):
        with contextlib.suppress(UnicodeDecodeError):
            text = line.decode(encoding).strip()
            return None if "\0" in text else text
    return None


def _header_cells(path: Path, text: str, delimiter: str) -> list[str]:
    try:
        return next(csv.reader([text], delimiter=delimiter, skipinitialspace=True))
    except csv.Error as error:
        raise RunError(f"{path}: the first line cannot be read ({error}); wanted the columns' names") from error


def _lines_before_header(lines: Sequence[str], wanted: Sequence[str]) -> int:
    """Lines before the header, which is the first line with all wanted names, else the first non-comment."""
    for number, line in enumerate(lines):
        text = line.lstrip("".join(_COMMENTS)).strip()
        if set(wanted) <= {cell.strip() for cell in text.split(max(_DELIMITERS, key=text.count))}:
            return number
    return next((number for number, line in enumerate(lines) if line and not _is_comment(line)), 0)


def _is_comment(line: str) -> bool:
    return line.startswith(_COMMENTS)


def _decimal_mark(rows: Sequence[str], header: Sequence[str], delimiter: str, wanted: Sequence[str]) -> str:
    """A comma if cells of the wanted columns look like 1,5 and none like 1.5. Other columns may hold dates."""
    used = [place for place, name in enumerate(header) if name in wanted]
    cells = [row.split(delimiter) for row in rows]
    # a row with fewer cells than the header is malformed: commas in it may separate cells
    text = " ".join(row[place] for row in cells if len(row) >= len(header) for place in used)
    return "," if re.search(r"\d,\d", text) and not re.search(r"\d\.\d", text) else "."


def _twice_as_many(rows: Sequence[str], cells: int) -> bool:
    """Whether every row has twice as many cells as the header, all whole numbers: 0,05,1,25 for 0.05 and 1.25."""
    filled = [row for row in rows if row][:-1]  # the last one may be cut off
    numbers = all(re.fullmatch(r"[-+\d, ]+", row) for row in filled)
    return bool(filled) and numbers and all(row.count(",") + 1 == 2 * cells for row in filled)


def _first_lines(path: Path) -> list[bytes]:
    """The first lines of the file, among which the header is searched; any kind of line end."""
    most = limit("header_bytes")
    with path.open("rb") as file:
        start = file.read(most + 1)
    lines = start.splitlines()[:_MAX_HEADER_LINES] or [b""]
    if len(start) > most and len(lines) == 1:
        raise too_much("header_bytes", f"more than {most} bytes in the first line", str(path))
    return lines


def _has_rows(path: Path, layout: _Layout) -> bool:
    with path.open("rb") as file:
        file.seek(sum(len(line) for line in _first_lines(path)[: layout.before + 1]))
        while piece := file.read(_READ_BYTES):
            if piece.strip():
                return True
    return False


def _read_as_text(
    path: Path, wanted: Sequence[str], layout: _Layout, malformed: list[tuple[int, int]]
) -> pyarrow.Table:
    import pyarrow

    with contextlib.suppress(pyarrow.ArrowInvalid):
        return _parse(path, wanted, layout, pyarrow.string(), malformed)
    malformed.clear()
    try:  # in Latin-1 every byte is a character, so the bad cell can be named
        return _parse(path, wanted, replace(layout, encoding="latin-1"), pyarrow.string(), malformed)
    except pyarrow.ArrowInvalid as error:
        reason = str(error).splitlines()[0]
        raise RunError(f"{path}: cannot be read as CSV ({reason}); wanted a header line and rows of numbers") from error


def _parse(
    path: Path, wanted: Sequence[str], layout: _Layout, kind: pyarrow.DataType, malformed: list[tuple[int, int]]
) -> pyarrow.Table:

    def skip(row: Any) -> str:
        malformed.append((row.number, row.actual_columns))
        return "skip"

    with _without_tracebacks():
        return _read(path, wanted, layout, kind, skip)


@contextlib.contextmanager
def _without_tracebacks() -> Iterator[None]:
    """Suppresses the traceback that pyarrow prints for a line that is not text, before it raises."""
    before = sys.unraisablehook
    sys.unraisablehook = lambda _: None
    try:
        yield
    finally:
        sys.unraisablehook = before


def _read(
    path: Path, wanted: Sequence[str], layout: _Layout, kind: pyarrow.DataType, skip: Callable[[Any], str]
) -> pyarrow.Table:
    from pyarrow import csv as arrow_csv

    return arrow_csv.read_csv(
        path,
        read_options=arrow_csv.ReadOptions(
            use_threads=False,  # with threads pyarrow does not report line numbers
            skip_rows=layout.before + 1,
            column_names=layout.header,
            encoding=layout.encoding,
        ),
        parse_options=arrow_csv.ParseOptions(delimiter=layout.delimiter, invalid_row_handler=skip),
        convert_options=arrow_csv.ConvertOptions(
            include_columns=list(wanted),
            column_types=dict.fromkeys(wanted, kind),
            null_values=_NULLS,
            decimal_point=layout.point,
        ),
    )


def _numbers(table: pyarrow.Table, wanted: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    return {name: np.asarray(table.column(name).to_numpy(), dtype=np.float64) for name in wanted}


def _numbers_from_text(
    path: Path, texts: pyarrow.Table, wanted: Sequence[str], malformed: list[tuple[int, int]], layout: _Layout
) -> dict[str, NDArray[np.float64]]:
    """Slow path if some cell is not a number: raises for the first one, but drops a last line that was cut off."""
    rows = texts.num_rows
    cells, point = {name: texts.column(name).to_pylist() for name in wanted}, layout.point
    bad = min((_first_bad(cells[name], point), name) for name in wanted)
    row, name = bad
    if row == rows:  # every cell is a number: pyarrow does not accept some kinds of blanks around one
        return {name: np.array([_number(cell, point) for cell in column]) for name, column in cells.items()}
    line = _line_of(row, malformed, layout.before)
    if row < rows - 1 or _ends_with_newline(path):
        place = f"{path}: line {_line_in_file(path, line, layout.before)}, column '{name}'"
        raise RunError(f"{place}: {_bad_cell_message(str(cells[name][row]), point)}")
    malformed.append((line, -1))
    return {name: np.array([_number(cell, point) for cell in column[:-1]]) for name, column in cells.items()}


def _bad_cell_message(cell: str, point: str) -> str:
    """Describes a bad cell and how to fix it."""
    wanted = "wanted a number" if point == "." else "wanted a number with a decimal comma, as in other cells"
    fix = "write it as seconds" if _DATE.match(cell) else "correct or remove the line"
    return f"got '{readable(cell)}', {wanted}; {fix}"


def _first_bad(cells: Sequence[str | None], point: str) -> int:
    for row, cell in enumerate(cells):
        try:
            _number(cell, point)
        except ValueError:
            return row
    return len(cells)


def _number(cell: str | None, point: str) -> float:
    """Converts a cell; raises ValueError if it is not a number.

    Stricter than ``float``, which accepts 1_0 and digits of other scripts. With decimal commas a point is refused,
    because it may separate thousands (1.234).
    """
    if cell is None or cell.strip() in _NULLS:
        return float("nan")
    if "_" in cell or not cell.isascii() or (point == "," and "." in cell):
        raise ValueError(cell)
    return float(cell.replace(",", ".") if point == "," else cell)


def _line_of(row: int, malformed: list[tuple[int, int]], before: int) -> int:
    """Line number of a row, from 1, given the dropped lines; blank lines after the header are not counted."""
    line = row + before + 2
    for dropped, _ in sorted(malformed):
        line += dropped <= line
    return line


def _line_in_file(path: Path, line: int, before: int) -> int:
    """Converts a line number without blank lines after the header into the line number in the file."""
    with path.open(encoding="latin-1") as file:
        filled = (number for number, text in enumerate(file, 1) if text != "\n" or number <= before + 1)
        return next(islice(filled, line - 1, None), line)


def _check_quotes(path: Path, layout: _Layout, read: int) -> None:
    """Raises RunError for a stray quotation mark that swallows whole rows: pyarrow would read them as one cell.

    A quoted note over several lines is accepted. ``read`` is the number of lines after the header that pyarrow found.
    """
    if not _may_have_open_quotes(path, layout.before + 1 + read):
        return
    mark = re.escape(layout.delimiter)
    closed, opens = re.compile(f'(^|{mark})"(?:[^"]|"")*"'), re.compile(f'(?:^|{mark})"')
    opened = 0
    with path.open(encoding="latin-1") as file:
        for number, line in enumerate(file, 1):
            if opened and '"' not in line and line.count(layout.delimiter) + 1 == len(layout.header) > 1:
                raise RunError(
                    f"{path}: line {opened}: a quotation mark opens there and none closes it on that line, so the rows "
                    "after it would be read as text; correct or remove the line"
                )
            rest = line.partition('"')[2] if opened else line
            if '"' in line and number > layout.before:
                opened = number if opens.search(closed.sub(r"\1", rest)) else 0


def _may_have_open_quotes(path: Path, known: int) -> bool:
    """Whether the file has quotation marks, and a number of lines other than ``known``."""
    marks = ends = 0
    last = b"\n"
    with path.open("rb") as file:
        while piece := file.read(1 << 20):
            marks += piece.count(b'"')
            ends += piece.count(b"\n")
            last = piece[-1:]
    return marks > 0 and ends + (last != b"\n") != known


def _ends_with_newline(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, 2)
        return file.read(1) in b"\r\n"


def _malformed_finding(path: Path, malformed: list[tuple[int, int]], layout: _Layout) -> Finding:
    line = _line_in_file(path, malformed[0][0], layout.before)
    lines = "line was" if len(malformed) == 1 else "lines were"
    return Finding(
        "malformed_line",
        f"{len(malformed)} {lines} cut off or had another number of cells than the header's {len(layout.header)}, "
        f"first line {line}; dropped",
        len(malformed),
    )
