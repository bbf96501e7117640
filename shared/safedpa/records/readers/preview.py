"""Previews a file: the names of its columns and its first rows, as text."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safedpa.errors import RunError
from safedpa.limits import limit, too_much
from safedpa.records.column_map.propose import sources_of
from safedpa.records.readers.arrays import arrays_in, column_names
from safedpa.records.readers.bags import kind_of, topic_log
from safedpa.records.readers.dialect import CsvFile, decoded, find_layout
from safedpa.records.readers.own_process import in_own_process
from safedpa.records.readers.parquet import dataset_files, is_dataset, open_parquet
from safedpa.records.readers.table import WANTED, regular_file

__all__ = ["RowPreview", "raw_rows"]

_MAX_ELEMENTS = 64
"""Elements of a list that are named as columns."""


@dataclass(frozen=True)
class RowPreview:
    """Column names and first rows of a file, as text; no columns for a bus recording."""

    names: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def raw_rows(path: str | Path, count: int = 5) -> RowPreview:
    """Returns the first rows of a table, or the field names of a log of topics; raises RunError if unreadable."""
    with regular_file(Path(path)) as file:
        return _raw_rows(file, count)


@in_own_process
def _raw_rows(path: Path, count: int) -> RowPreview:
    if path.is_dir() and is_dataset(path):
        path = dataset_files(path)[0]
    if not path.is_file():
        raise RunError(f"{path}: no such file; wanted {WANTED}")
    try:
        with path.open("rb") as file:
            start = file.read(8)
        if kind_of(path) == "topics":
            return RowPreview(tuple(sources_of(topic_log(path).topics().values(), clocks=True)), ())
        if start.startswith(b"\x89MCAP"):
            return RowPreview((), ())
        if kind_of(path) == "arrays":
            return RowPreview(tuple(column_names(arrays_in(path))), ())
        return _parquet(path, count) if start.startswith(b"PAR1") else _csv(path, count)
    except (OSError, UnicodeDecodeError, csv.Error, ValueError) as error:
        raise RunError(f"{path}: cannot be read ({str(error)[:120]}); wanted a table with a header line") from error


def _csv(path: Path, count: int) -> RowPreview:
    file = CsvFile(path)
    layout = find_layout(file, ())
    if len(layout.header) > limit("columns"):
        raise too_much("columns", len(layout.header), str(path))
    lines = [decoded(line) or "" for line in file.first_lines()[layout.before + layout.skipped + 1 :]]
    cells = (next(csv.reader([line], delimiter=layout.delimiter), []) for line in lines[:count])
    rows = tuple(tuple(cell.strip() for cell in row) for row in cells)
    names = layout.header if layout.header[-1] else layout.header[:-1]
    return RowPreview(tuple(names), rows)


def _parquet(path: Path, count: int) -> RowPreview:
    from pyarrow import types

    with open_parquet(path) as table:
        kinds = {name: table.schema_arrow.field(name).type for name in table.schema_arrow.names}
        lists = [name for name, kind in kinds.items() if types.is_list(kind) or types.is_fixed_size_list(kind)]
        plain = [name for name, kind in kinds.items() if types.is_primitive(kind)]
        batch = next(table.iter_batches(batch_size=count, columns=[*plain, *lists]), None)
    rows: list[dict[str, Any]] = [] if batch is None else batch.to_pylist()
    columns: dict[str, list[str]] = {}
    for name in kinds:
        values = [row.get(name) for row in rows]
        longest = max((len(value) for value in values if value is not None), default=0) if name in lists else 0
        if longest:
            for place in range(min(longest, _MAX_ELEMENTS)):
                columns[f"{name}[{place}]"] = [
                    str(value[place])[:80] if value is not None and place < len(value) else "" for value in values
                ]
        else:
            columns[name] = [str(value)[:80] if name in plain else "-" for value in values]
    return RowPreview(tuple(columns), tuple(zip(*columns.values(), strict=True)))
