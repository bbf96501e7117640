"""CSV files as tables, fast, and with line and column of what is no number."""

from __future__ import annotations

import contextlib
import csv
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import RunError
from safedpa.limits import limit, readable, too_much
from safedpa.records.run import Finding
from safedpa.records.table import Table, require_columns, require_file

if TYPE_CHECKING:
    import pyarrow

__all__ = ["read_csv_table"]

_DELIMITERS = ",;\t"
_NULLS = ["", "nan", "NaN", "NAN", "NA", "N/A", "null", "NULL", "None", "-nan"]
_PIECE = 1 << 16
_FIRST = 60
"""Lines among which the header is looked for."""
_COMMENTS = ("#", "%", "//")


def read_csv_table(path: Path, wanted: Sequence[str]) -> Table:
    """The wanted columns of a CSV file with a header line, separated by comma, semicolon or tab.

    Lines with too few or too many cells, and a last line that was cut off within a number, are dropped and reported.
    Raises RunError when a column is missing, or naming line and column of the first cell that is no number.
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
        columns = _numbers_of_texts(path, _texts(path, wanted, layout, malformed), wanted, malformed, layout)
    findings = (_malformed_finding(malformed, len(layout.header)),) if malformed else ()
    return Table(columns, (*layout.findings, *findings))


@dataclass(frozen=True)
class _Layout:
    """How a file is written: lines before the header's, the columns' names, what separates cells, the decimal mark."""

    before: int
    header: list[str]
    delimiter: str
    point: str
    findings: tuple[Finding, ...]


def _layout(path: Path, wanted: Sequence[str]) -> _Layout:
    try:
        lines = [line.decode("utf-8-sig").strip() for line in _first_lines(path)]
    except UnicodeDecodeError as error:
        raise RunError(f"{path}: the first line is no text; wanted a CSV file with a header line") from error
    before = _lines_before(lines, wanted)
    text = lines[before].lstrip("".join(_COMMENTS)).strip() if before or _commented(lines[0]) else lines[0]
    if not text:
        raise RunError(f"{path}: the first line is empty; wanted a header line with the columns' names")
    delimiter = max(_DELIMITERS, key=text.count)
    header = _cells(path, text, delimiter)
    findings = []
    if before:
        said = f"{before} {'line' if before == 1 else 'lines'} before the header were taken for comments and left out"
        findings.append(Finding("comment_lines", f"{said}; the header is line {before + 1}", before))
    point = "." if delimiter == "," else _decimal_mark(lines[before + 1 :])
    if point == ",":
        text = "numbers have decimal commas; they were read as such; write points to be understood everywhere"
        findings.append(Finding("decimal_comma", text))
    elif delimiter == "," and _twice_as_many(lines[before + 1 :], len(header)):
        raise RunError(
            f"{path}: rows have twice as many cells as the header's {len(header)}: decimal commas in a file that "
            "commas separate; save it with decimal points, or with semicolons between the cells"
        )
    return _Layout(before, header, delimiter, point, tuple(findings))


def _cells(path: Path, text: str, delimiter: str) -> list[str]:
    try:
        return next(csv.reader([text], delimiter=delimiter, skipinitialspace=True))
    except csv.Error as error:
        raise RunError(f"{path}: the first line cannot be read ({error}); wanted the columns' names") from error


def _lines_before(lines: Sequence[str], wanted: Sequence[str]) -> int:
    """How many lines stand before the header: none where the first one is no comment and no other has the names."""
    for number, line in enumerate(lines):
        text = line.lstrip("".join(_COMMENTS)).strip()
        if text and set(wanted) <= {cell.strip() for cell in text.split(max(_DELIMITERS, key=text.count))}:
            return number
    return next((number for number, line in enumerate(lines) if line and not _commented(line)), 0)


def _commented(line: str) -> bool:
    return line.startswith(_COMMENTS)


def _decimal_mark(rows: Sequence[str]) -> str:
    """A comma where cells look like 1,5 and none like 1.5."""
    text = " ".join(rows)
    return "," if re.search(r"\d,\d", text) and not re.search(r"\d\.\d", text) else "."


def _twice_as_many(rows: Sequence[str], cells: int) -> bool:
    """Whether every row has twice the header's cells, whole numbers all: 0,05,1,25 for 0.05 and 1.25."""
    filled = [row for row in rows if row][:-1]  # the last one may be cut off
    numbers = all(re.fullmatch(r"[-+\d, ]+", row) for row in filled)
    return bool(filled) and numbers and all(row.count(",") + 1 == 2 * cells for row in filled)


def _first_lines(path: Path) -> list[bytes]:
    """The lines among which the header is looked for, up to line ends of any kind."""
    most = limit("header_bytes")
    with path.open("rb") as file:
        start = file.read(most + 1)
    lines = start.splitlines()[:_FIRST] or [b""]
    if len(start) > most and len(lines) == 1:
        raise too_much("header_bytes", f"more than {most} bytes in the first line", str(path))
    return lines


def _has_rows(path: Path, layout: _Layout) -> bool:
    with path.open("rb") as file:
        file.seek(sum(len(line) for line in _first_lines(path)[: layout.before + 1]))
        while piece := file.read(_PIECE):
            if piece.strip():
                return True
    return False


def _texts(path: Path, wanted: Sequence[str], layout: _Layout, malformed: list[tuple[int, int]]) -> pyarrow.Table:
    import pyarrow

    try:
        return _parse(path, wanted, layout, pyarrow.string(), malformed)
    except pyarrow.ArrowInvalid as error:
        reason = str(error).splitlines()[0]
        raise RunError(f"{path}: cannot be read as CSV ({reason}); wanted a header line and rows of numbers") from error


def _parse(
    path: Path, wanted: Sequence[str], layout: _Layout, kind: pyarrow.DataType, malformed: list[tuple[int, int]]
) -> pyarrow.Table:

    def skip(row: Any) -> str:
        malformed.append((row.number, row.actual_columns))
        return "skip"

    with _quiet():
        return _read(path, wanted, layout, kind, skip)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """A line that is no text makes the library print a traceback, and drop the line as it should."""
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
            use_threads=False,  # with threads the reader does not know line numbers
            skip_rows=layout.before + 1,
            column_names=layout.header,
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


def _numbers_of_texts(
    path: Path, texts: pyarrow.Table, wanted: Sequence[str], malformed: list[tuple[int, int]], layout: _Layout
) -> dict[str, NDArray[np.float64]]:
    """The slow road, when some cell is no number: finds the first; forgives it in a last line that was cut off."""
    rows = texts.num_rows
    cells = {name: _pointed(texts.column(name).to_pylist(), layout.point) for name in wanted}
    bad = min((_first_bad(cells[name]), name) for name in wanted)
    row, name = bad
    if row == rows:  # blanks around a number, of a kind that the fast reader does not know
        return {name: np.array([_number(cell) for cell in column]) for name, column in cells.items()}
    line = _line_of(row, malformed) + layout.before
    if row < rows - 1 or _ends_with_newline(path):
        raise RunError(
            f"{path}: line {line}, column '{name}': got '{readable(str(cells[name][row]))}', wanted a number; "
            "correct or remove the line"
        )
    malformed.append((line, -1))
    return {name: np.array([_number(cell) for cell in column[:-1]]) for name, column in cells.items()}


def _pointed(cells: list[str | None], point: str) -> list[str | None]:
    return cells if point == "." else [cell and cell.replace(",", ".") for cell in cells]


def _first_bad(cells: Sequence[str | None]) -> int:
    for row, cell in enumerate(cells):
        try:
            _number(cell)
        except ValueError:
            return row
    return len(cells)


def _number(cell: str | None) -> float:
    """Raises ValueError for what is no number; Python would take 1_0 for ten, and digits of any script."""
    if cell is None or cell.strip() in _NULLS:
        return float("nan")
    if "_" in cell or not cell.isascii():
        raise ValueError(cell)
    return float(cell)


def _line_of(row: int, malformed: list[tuple[int, int]]) -> int:
    """Line in the file (from 1, the header's) of a row of the table, given the lines that were dropped before it."""
    line = row + 2
    for dropped, _ in sorted(malformed):
        line += dropped <= line
    return line


def _ends_with_newline(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, 2)
        return file.read(1) in b"\r\n"


def _malformed_finding(malformed: list[tuple[int, int]], cells: int) -> Finding:
    line, _ = malformed[0]
    lines = "line was" if len(malformed) == 1 else "lines were"
    return Finding(
        "malformed_line",
        f"{len(malformed)} {lines} cut off or had another number of cells than the header's {cells}, "
        f"first line {line}; dropped",
        len(malformed),
    )
