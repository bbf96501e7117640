"""Previews a file: the names of its columns and its first rows, as text."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

from safedpa.errors import RunError
from safedpa.limits import limit, too_much
from safedpa.records.column_map.propose import sources_of
from safedpa.records.readers.bags import kind_of, topic_log
from safedpa.records.readers.parquet import open_parquet

__all__ = ["RowPreview", "raw_rows"]

_DELIMITERS = ",;\t"


@dataclass(frozen=True)
class RowPreview:
    """Column names and first rows of a file, as text; no columns for a bus recording."""

    names: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def raw_rows(path: str | Path, count: int = 5) -> RowPreview:
    """Returns the first rows of a table, or the field names of a log of topics; raises RunError if unreadable."""
    path = Path(path)
    if not path.is_file():
        raise RunError(f"{path}: no such file; wanted a recording (.csv, .parquet or .mcap)")
    try:
        with path.open("rb") as file:
            start = file.read(8)
        if kind_of(path) == "topics":
            return RowPreview(tuple(sources_of(topic_log(path).topics().values(), clocks=True)), ())
        if start.startswith(b"\x89MCAP"):
            return RowPreview((), ())
        return _parquet(path, count) if start.startswith(b"PAR1") else _csv(path, count)
    except (OSError, UnicodeDecodeError, csv.Error, ValueError) as error:
        raise RunError(f"{path}: cannot be read ({str(error)[:120]}); wanted a table with a header line") from error


def _csv(path: Path, count: int) -> RowPreview:
    most = limit("header_bytes")
    with path.open(encoding="utf-8-sig", newline="") as file:
        first = file.readline(most + 1)
        if len(first) > most:
            raise too_much("header_bytes", f"more than {most} characters in the first line", str(path))
        delimiter = max(_DELIMITERS, key=first.count)
        lines = csv.reader([first, *(file.readline(most) for _ in range(count))], delimiter=delimiter)
        header, *rows = [tuple(cell.strip() for cell in line) for line in lines] or [()]
    if len(header) > limit("columns"):
        raise too_much("columns", len(header), str(path))
    if not any(header):
        raise RunError(f"{path}: the first line is empty; wanted a header line with the columns' names")
    return RowPreview(header, tuple(rows))


def _parquet(path: Path, count: int) -> RowPreview:
    import pyarrow

    with open_parquet(path) as table:
        names = tuple(table.schema_arrow.names)
        numbers = [name for name in names if pyarrow.types.is_primitive(table.schema_arrow.field(name).type)]
        batch = next(table.iter_batches(batch_size=count, columns=numbers), None)
    cells = (
        {}
        if batch is None
        else {name: [str(cell)[:80] for cell in column] for name, column in batch.to_pydict().items()}
    )
    length = 0 if batch is None else batch.num_rows
    return RowPreview(names, tuple(zip(*(cells.get(name, ["-"] * length) for name in names), strict=True)))
