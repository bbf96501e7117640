"""CSV files as tables, fast, and with line and column of what is no number."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import RunError
from safedpa.records.run import Finding
from safedpa.records.table import Table, require_columns, require_file

if TYPE_CHECKING:
    import pyarrow

__all__ = ["read_csv_table"]

_DELIMITERS = ",;\t"
_NULLS = ["", "nan", "NaN", "NAN", "NA", "N/A", "null", "NULL", "None", "-nan"]
_LONGEST_HEADER = 1 << 16


def read_csv_table(path: Path, wanted: Sequence[str]) -> Table:
    """The wanted columns of a CSV file with a header line, separated by comma, semicolon or tab.

    Lines with too few or too many cells, and a last line that was cut off within a number, are dropped and reported.
    Raises RunError when a column is missing, or naming line and column of the first cell that is no number.
    """
    import pyarrow

    require_file(path)
    header, delimiter = _header(path)
    require_columns(path, wanted, header)
    if not _has_rows(path):
        return Table({name: np.empty(0) for name in wanted})
    malformed: list[tuple[int, int]] = []
    try:
        columns = _numbers(_parse(path, wanted, delimiter, pyarrow.float64(), malformed), wanted)
    except pyarrow.ArrowInvalid:
        malformed.clear()
        columns = _numbers_of_texts(path, _texts(path, wanted, delimiter, malformed), wanted, malformed)
    findings = (_malformed_finding(malformed, len(header)),) if malformed else ()
    return Table(columns, findings)


def _header(path: Path) -> tuple[list[str], str]:
    try:
        text = _first_line(path).decode("utf-8-sig").strip()
    except UnicodeDecodeError as error:
        raise RunError(f"{path}: the first line is no text; wanted a CSV file with a header line") from error
    if not text:
        raise RunError(f"{path}: the first line is empty; wanted a header line with the columns' names")
    delimiter = max(_DELIMITERS, key=text.count)
    try:
        return next(csv.reader([text], delimiter=delimiter)), delimiter
    except csv.Error as error:
        raise RunError(f"{path}: the first line cannot be read ({error}); wanted the columns' names") from error


def _first_line(path: Path) -> bytes:
    """Up to the first line end of any kind."""
    with path.open("rb") as file:
        return file.readline(_LONGEST_HEADER).splitlines()[0]


def _has_rows(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(len(_first_line(path)))
        return any(line.strip() for line in file)


def _texts(path: Path, wanted: Sequence[str], delimiter: str, malformed: list[tuple[int, int]]) -> pyarrow.Table:
    import pyarrow

    try:
        return _parse(path, wanted, delimiter, pyarrow.string(), malformed)
    except pyarrow.ArrowInvalid as error:
        reason = str(error).splitlines()[0]
        raise RunError(f"{path}: cannot be read as CSV ({reason}); wanted a header line and rows of numbers") from error


def _parse(
    path: Path, wanted: Sequence[str], delimiter: str, kind: pyarrow.DataType, malformed: list[tuple[int, int]]
) -> pyarrow.Table:
    from pyarrow import csv as arrow_csv

    def skip(row: Any) -> str:
        malformed.append((row.number, row.actual_columns))
        return "skip"

    return arrow_csv.read_csv(
        path,
        read_options=arrow_csv.ReadOptions(use_threads=False),  # with threads the reader does not know line numbers
        parse_options=arrow_csv.ParseOptions(delimiter=delimiter, invalid_row_handler=skip),
        convert_options=arrow_csv.ConvertOptions(
            include_columns=list(wanted), column_types=dict.fromkeys(wanted, kind), null_values=_NULLS
        ),
    )


def _numbers(table: pyarrow.Table, wanted: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    return {name: np.asarray(table.column(name).to_numpy(), dtype=np.float64) for name in wanted}


def _numbers_of_texts(
    path: Path, texts: pyarrow.Table, wanted: Sequence[str], malformed: list[tuple[int, int]]
) -> dict[str, NDArray[np.float64]]:
    """The slow road, when some cell is no number: finds the first; forgives it in a last line that was cut off."""
    rows = texts.num_rows
    cells = {name: texts.column(name).to_pylist() for name in wanted}
    bad = min((_first_bad(cells[name]), name) for name in wanted)
    row, name = bad
    line = _line_of(row, malformed)
    if row < rows - 1 or _ends_with_newline(path):
        raise RunError(
            f"{path}: line {line}, column '{name}': got '{cells[name][row]}', wanted a number; "
            "correct or remove the line"
        )
    malformed.append((line, -1))
    return {name: np.array([_number(cell) for cell in column[:-1]]) for name, column in cells.items()}


def _first_bad(cells: list[str]) -> int:
    for row, cell in enumerate(cells):
        try:
            _number(cell)
        except ValueError:
            return row
    return len(cells)


def _number(cell: str | None) -> float:
    return float("nan") if cell is None or cell.strip() in _NULLS else float(cell)


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
