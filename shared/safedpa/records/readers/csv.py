"""Reads CSV files as tables; an error names the line and column of the bad cell."""

from __future__ import annotations

import contextlib
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import RunError
from safedpa.limits import limit, readable, too_much
from safedpa.records.readers.cells import (
    DATE,
    NULLS,
    Cells,
    element_of,
    floats_of,
    has_decimal_commas,
    missing_value_findings,
    numbers_of_texts,
)
from safedpa.records.readers.dialect import CsvFile, Layout, decimal_comma_finding, find_layout
from safedpa.records.readers.table import Table, require_columns, require_file
from safedpa.records.run import Finding

if TYPE_CHECKING:
    import pyarrow

__all__ = ["read_csv_table"]

_READ_BYTES = 1 << 16
_NEIGHBOURS = 20
"""Lines above the last one whose cells are compared with it."""
_TEXT_SHARE = 0.01
"""Share of the rows that may have a word in place of a number."""
_NULL = f"^({'|'.join(map(re.escape, NULLS))})$"


def read_csv_table(path: Path, wanted: Sequence[str]) -> Table:
    """Reads the wanted columns of a CSV file with a header line, in any dialect that ``dialect`` finds.

    Lines with too few or too many cells, lines without any number, and a last line that was cut off within a number are
    dropped and reported. Raises RunError for a missing column, and for the first cell that is neither a number nor a
    missing value, with its line and column.
    """
    import pyarrow

    require_file(path)
    file = CsvFile(path)
    layout = find_layout(file, wanted)
    if len(layout.header) > limit("columns"):
        raise too_much("columns", len(layout.header), str(path))
    elements = {name: found for name in wanted if (found := element_of(name.strip(), layout.header))}
    sources = list(dict.fromkeys(elements[name][0] if name in elements else name.strip() for name in wanted))
    require_columns(path, sources, layout.header)
    if not _has_rows(file, layout):
        return Table({name: np.empty(0) for name in wanted}, layout.findings)
    reader = _Reader(file, layout, [])
    if elements:
        return _with_elements(reader, wanted, elements, sources)
    try:
        texts = reader.parse(sources, pyarrow.float64())
        columns, findings = {name: floats_of(texts.column(name)) for name in sources}, layout.findings
        timed = frozenset[str]()
    except pyarrow.ArrowInvalid:
        reader.malformed.clear()
        columns, timed, findings = _numbers_from_text(reader, sources)
    _check_quotes(reader, len(columns[sources[0]]) + len(reader.malformed))
    numbers = {name: columns[name.strip()] for name in wanted}
    times = frozenset(name for name in wanted if name.strip() in timed)
    table = Table(numbers, (*findings, *reader.malformed_finding()), timed=times)
    last_line = reader.before + 1 + len(table) + len(reader.malformed)
    if layout.header[-1] not in sources or last_line in dict(reader.malformed):
        return table
    return _without_cut_row(table, file, layout)


def _with_elements(
    reader: _Reader, wanted: Sequence[str], elements: dict[str, tuple[str, int]], sources: Sequence[str]
) -> Table:
    """Reads a table with lists in its cells, such as "[0.1, 0.2]"."""
    texts = reader.as_text(sources)
    lists: dict[str, list[list[str]]] = {}
    for name in {source for source, _ in elements.values()}:
        lists[name] = [re.split(r"[\s,;]+", (cell or "").strip("[](){} ")) for cell in texts.column(name).to_pylist()]
    columns: dict[str, NDArray[np.float64]] = {}
    for name in wanted:
        if name in elements:
            source, place = elements[name]
            cells: list[str | None] = [row[place] if place < len(row) else None for row in lists[source]]
        else:
            cells = texts.column(name.strip()).to_pylist()
        found = numbers_of_texts(cells, ".")
        if found.bad:
            raise reader.bad_cell(name, found.bad[0], str(cells[found.bad[0]]))
        columns[name] = found.values
    return Table(columns, (*reader.layout.findings, *reader.malformed_finding()))


def _has_rows(file: CsvFile, layout: Layout) -> bool:
    with file.open() as opened:
        for _ in range(layout.before + 1 + layout.skipped):
            opened.readline()
        while piece := opened.read(_READ_BYTES):
            if piece.strip():
                return True
    return False


def _without_cut_row(table: Table, file: CsvFile, layout: Layout) -> Table:
    """Drops the last row if the file seems to end within its last cell, of which a number is left."""
    with file.open() as opened:
        opened.seek(max(0, file.size - _READ_BYTES))
        tail = opened.read()
    lines = [] if tail.endswith((b"\n", b"\r")) else tail.splitlines()[-_NEIGHBOURS - 1 :]
    mark = layout.delimiter.encode()
    cells = [line.rpartition(mark)[2].strip() for line in lines if line.count(mark) + 1 == len(layout.header)]
    if len(cells) <= _NEIGHBOURS or len(cells[-1]) >= min(map(len, cells[:-1])):
        return table
    text = "the last line has no end, and its last cell is shorter than those above it: it may be cut off; dropped"
    return replace(table.taken(slice(-1)), findings=(*table.findings, Finding("cut_off", text, 1)))


@dataclass
class _Reader:
    """Parses a CSV file with pyarrow; ``malformed`` gets (line, cells) of lines with another number of cells."""

    file: CsvFile
    layout: Layout
    malformed: list[tuple[int, int]]

    @property
    def before(self) -> int:
        """Lines before the last one in front of the rows."""
        return self.layout.before + self.layout.skipped

    def as_text(self, names: Sequence[str]) -> pyarrow.Table:
        """The columns as texts."""
        import pyarrow

        with contextlib.suppress(pyarrow.ArrowInvalid):
            return self.parse(names, pyarrow.string())
        self.malformed.clear()
        try:  # in Latin-1 every byte is a character, so the bad cell can be named
            self.layout = replace(self.layout, encoding="latin-1")
            return self.parse(names, pyarrow.string())
        except pyarrow.ArrowInvalid as error:
            reason = str(error).splitlines()[0]
            raise RunError(
                f"{self.file.path}: cannot be read as CSV ({reason}); wanted a header line and rows of numbers"
            ) from error

    def parse(self, names: Sequence[str], kind: pyarrow.DataType) -> pyarrow.Table:
        """The columns as a type; raises ArrowInvalid if a cell has another one."""

        def skip(row: Any) -> str:
            self.malformed.append((row.number, row.actual_columns))
            return "skip"

        with _without_tracebacks():
            return _read(self.file, names, self.layout, self.before, kind, skip)

    def bad_cell(self, name: str, row: int, cell: str) -> RunError:
        """The error for a cell that is no number, and how to fix it."""
        point = self.layout.point
        wanted = "wanted a number" if point == "." else "wanted a number with a decimal comma, as in other cells"
        fix = "write it as seconds" if DATE.match(cell) else "correct or remove the line"
        line = self.line_in_file(self.line_of(row))
        return RunError(f"{self.file.path}: line {line}, column '{name}': got '{readable(cell)}', {wanted}; {fix}")

    def line_of(self, row: int) -> int:
        """Line number of a row, from 1, given the dropped lines; blank lines after the header are not counted."""
        line = row + self.before + 2
        for dropped, _ in sorted(self.malformed):
            line += dropped <= line
        return line

    def line_in_file(self, line: int) -> int:
        """Converts a line number without blank lines after the header into the line number in the file."""
        with self.file.open() as file:
            filled = (number for number, text in enumerate(file, 1) if text != b"\n" or number <= self.before + 1)
            return next(islice(filled, line - 1, None), line)

    def malformed_finding(self) -> tuple[Finding, ...]:
        """The finding for the dropped lines."""
        if not self.malformed:
            return ()
        line = self.line_in_file(min(self.malformed)[0])
        lines = "line was" if len(self.malformed) == 1 else "lines were"
        text = (
            f"{len(self.malformed)} {lines} cut off, had another number of cells than the header's "
            f"{len(self.layout.header)}, or words for numbers, first line {line}; dropped"
        )
        return (Finding("malformed_line", text, len(self.malformed)),)


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
    file: CsvFile,
    names: Sequence[str],
    layout: Layout,
    before: int,
    kind: pyarrow.DataType,
    skip: Callable[[Any], str],
) -> pyarrow.Table:
    from pyarrow import csv as arrow_csv

    with file.open() as opened:
        return arrow_csv.read_csv(
            opened,
            read_options=arrow_csv.ReadOptions(
                use_threads=False,  # with threads pyarrow does not report line numbers
                skip_rows=before + 1,
                column_names=layout.header,
                encoding=layout.encoding,
            ),
            parse_options=arrow_csv.ParseOptions(delimiter=layout.delimiter, invalid_row_handler=skip),
            convert_options=arrow_csv.ConvertOptions(
                include_columns=list(names),
                column_types=dict.fromkeys(names, kind),
                null_values=NULLS,
                decimal_point=layout.point,
            ),
        )


def _numbers_from_text(
    reader: _Reader, names: Sequence[str]
) -> tuple[dict[str, NDArray[np.float64]], frozenset[str], tuple[Finding, ...]]:
    """Slow path if some cell is not a number; returns the columns, those that hold times, and the findings."""
    texts = reader.as_text(names)
    point, findings = reader.layout.point, reader.layout.findings
    columns = {name: _column(texts.column(name), point) for name in names}
    cells: dict[str, list[str | None]] = {
        name: texts.column(name).to_pylist() for name, found in columns.items() if found.bad
    }
    if point == "." and any(has_decimal_commas(cells[name], columns[name].bad) for name in cells):
        with_commas = {name: _column(texts.column(name), ",") for name in names}
        if sum(len(found.bad) for found in with_commas.values()) < sum(len(found.bad) for found in columns.values()):
            columns, findings = with_commas, (*findings, decimal_comma_finding())
            reader.layout = replace(reader.layout, point=",")
    dropped = _lines_of_text(reader, texts, columns)
    other = _other_table(reader, texts, names, dropped)
    findings = (*findings, *other[1])
    dropped |= other[0] | _rows_of_text(texts, columns, dropped)
    bad = min(((row, name) for name, found in columns.items() for row in found.bad if row not in dropped), default=None)
    if bad is not None:
        row, name = bad
        if row < texts.num_rows - 1 or _ends_with_newline(reader.file):
            raise reader.bad_cell(name, row, str(texts.column(name)[row].as_py()))
        dropped.add(row)
    lines = [reader.line_of(row) for row in sorted(dropped - other[0])]
    reader.malformed += [(line, -1) for line in lines]
    kept = np.delete(np.arange(texts.num_rows), sorted(dropped))
    markers: dict[str, Counter[str]] = {name: found.markers for name, found in columns.items()}
    timed = frozenset(name for name, found in columns.items() if found.is_time)
    return (
        {name: found.values[kept] for name, found in columns.items()},
        timed,
        (*findings, *missing_value_findings(markers)),
    )


def _column(column: pyarrow.ChunkedArray, point: str) -> Cells:
    """A column of text as numbers: all at once if every cell is one, else cell by cell."""
    import pyarrow
    from pyarrow import compute

    if point == ".":
        trimmed = compute.utf8_trim_whitespace(column)
        numbers = compute.replace_substring_regex(trimmed, pattern=_NULL, replacement="nan")
        with contextlib.suppress(pyarrow.ArrowInvalid):
            return Cells(floats_of(numbers.cast(pyarrow.float64())))
    return numbers_of_texts(column.to_pylist(), point)


def _lines_of_text(reader: _Reader, texts: pyarrow.Table, columns: dict[str, Cells]) -> set[int]:
    """Rows in which no wanted cell is a number, such as a repeated header, and those with zero bytes of a hole."""
    if len(columns) < 2:
        return set()
    bad = [set(found.bad) for found in columns.values()]
    common = set.intersection(*bad)
    holes = {
        row for name, found in columns.items() for row in found.bad if "\0" in str(texts.column(name)[row].as_py())
    }
    return (common if len(common) < texts.num_rows / 2 else set()) | holes


def _other_table(
    reader: _Reader, texts: pyarrow.Table, names: Sequence[str], dropped: set[int]
) -> tuple[set[int], tuple[Finding, ...]]:
    """Rows below a second header whose columns are in another order, up to the next header in this order."""
    found: set[int] = set()
    begin = None
    for row in [*sorted(dropped), texts.num_rows]:
        if begin is not None:
            found |= set(range(begin, row))
        cells = [(texts.column(name)[row].as_py() or "").strip() for name in names] if row < texts.num_rows else []
        begin = row + 1 if cells != list(names) and sum(cell in reader.layout.header for cell in cells) > 1 else None
    if not found:
        return found, ()
    line = reader.line_in_file(reader.line_of(min(found) - 1))
    text = f"line {line} is a header with other columns: the {len(found)} rows below it are of another table; left out"
    return found, (Finding("malformed_line", text, len(found)),)


def _rows_of_text(texts: pyarrow.Table, columns: dict[str, Cells], dropped: set[int]) -> set[int]:
    """Rows with a word in place of a number, such as "Total" or "ERR", if they are few."""
    rows = {row: name for name, found in columns.items() for row in found.bad if row not in dropped}
    if len(rows) > _TEXT_SHARE * texts.num_rows:
        return set()
    cells = [str(texts.column(name)[row].as_py()) for row, name in rows.items()]
    return set() if any(sign.isdigit() for cell in cells for sign in cell) else set(rows)


def _check_quotes(reader: _Reader, read: int) -> None:
    """Raises RunError for a stray quotation mark that swallows whole rows: pyarrow would read them as one cell.

    A quoted note over several lines is accepted. ``read`` is the number of lines after the header that pyarrow found.
    """
    layout = reader.layout
    if not _may_have_open_quotes(reader.file, reader.before + 1 + read):
        return
    mark = re.escape(layout.delimiter)
    closed, opens = re.compile(f'(^|{mark})"(?:[^"]|"")*"'), re.compile(f'(?:^|{mark})"')
    opened = 0
    with reader.file.open() as file:
        for number, data in enumerate(file, 1):
            line = data.decode("latin-1")
            if opened and '"' not in line and line.count(layout.delimiter) + 1 == len(layout.header) > 1:
                raise RunError(
                    f"{reader.file.path}: line {opened}: a quotation mark opens there and none closes it on that line, "
                    "so the rows after it would be read as text; correct or remove the line"
                )
            rest = line.partition('"')[2] if opened else line
            if '"' in line and number > layout.before:
                opened = number if opens.search(closed.sub(r"\1", rest)) else 0


def _may_have_open_quotes(file: CsvFile, known: int) -> bool:
    """Whether the file has quotation marks, and a number of lines other than ``known``."""
    marks = ends = 0
    last = b"\n"
    with file.open() as opened:
        while piece := opened.read(1 << 20):
            marks += piece.count(b'"')
            ends += piece.count(b"\n")
            last = piece[-1:]
    return marks > 0 and ends + (last != b"\n") != known


def _ends_with_newline(file: CsvFile) -> bool:
    with file.open() as opened:
        opened.seek(-1, 2)
        return opened.read(1) in b"\r\n"
