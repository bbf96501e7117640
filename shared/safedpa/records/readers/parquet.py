"""Reads Parquet files as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from safedpa.errors import RunError
from safedpa.limits import limit, too_much
from safedpa.records.readers.cells import Cells, element_of, floats_of, missing_value_findings, numbers_of_column
from safedpa.records.readers.own_process import allow_for
from safedpa.records.readers.table import Table, require_columns, require_file
from safedpa.records.run import Finding

if TYPE_CHECKING:
    import pyarrow
    from pyarrow.parquet import ParquetFile

__all__ = ["dataset_files", "is_dataset", "open_parquet", "read_dataset", "read_parquet_table"]

_NUMBER_BYTES = 8
_AROUND = 2
"""Rows before and after damaged values that are ignored as well."""
_EPISODE = "episode_index"
"""Column of a LeRobot dataset with the number of the episode."""
_MAX_FILES = 10_000
_MAGIC = (b"PAR1", b"PARE")
"""The last bytes, also of an encrypted file."""


def read_parquet_table(path: Path, wanted: Sequence[str]) -> Table:
    """Reads the wanted columns of a Parquet file; ``action[0]`` is an element of a column of lists.

    Raises RunError if it is not a Parquet file, or if a column is missing or has no numbers.
    """
    import pyarrow

    require_file(path)
    try:
        with open_parquet(path) as file:
            own = {name.strip(): name for name in file.schema_arrow.names}
            elements = {name: found for name in wanted if (found := element_of(name.strip(), list(own)))}
            sources = {name: elements[name][0] if name in elements else name.strip() for name in wanted}
            require_columns(path, list(dict.fromkeys(sources.values())), [n.strip() for n in file.schema_arrow.names])
            read = list(dict.fromkeys(own[source] for source in sources.values()))
            _check_size(path, file, len(wanted))
            table = file.read(columns=read)
            beyond = _beyond_statistics(file, table, own, sources)
        columns = {name: table.column(own[source]) for name, source in sources.items()}
        for name, (_, place) in elements.items():
            columns[name] = _element(path, name, columns[name], place)
        cells = {name: _cells(path, name, column) for name, column in columns.items()}
    except (pyarrow.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise RunError(f"{path}: cannot be read as Parquet ({reason}); it may be cut off or another format") from error
    timed = frozenset(name for name, found in cells.items() if found.is_time)
    markers = missing_value_findings({name: found.markers for name, found in cells.items()})
    for name, rows in beyond.items():
        cells[name].values[rows] = np.nan
    damage = [_damaged(name, rows) for name, rows in beyond.items()]
    return Table({name: found.values for name, found in cells.items()}, (*markers, *damage), timed=timed)


def _beyond_statistics(
    file: ParquetFile, table: pyarrow.Table, own: Mapping[str, str], sources: Mapping[str, str]
) -> dict[str, slice]:
    """Rows with values beyond the least and largest that their writer noted: pages often have no checksum.

    Of each column, the rows from the first to the last of them, and those around, which were overwritten as well.
    """
    from pyarrow import types

    about, found = file.metadata, {}
    places = {about.schema.column(k).path: k for k in range(about.num_columns)}
    for name, source in sources.items():
        column = table.column(own[source])
        place = places.get(own[source])
        if place is None or not types.is_floating(column.type):
            continue
        values, at = floats_of(column), 0
        bad = np.zeros(len(values), dtype=bool)
        for group in range(about.num_row_groups):
            count, noted = about.row_group(group).num_rows, about.row_group(group).column(place).statistics
            if noted is not None and noted.has_min_max and isinstance(noted.min, float):
                part = values[at : at + count]
                bad[at : at + count] = (part < noted.min) | (part > noted.max)
            at += count
        rows = np.flatnonzero(bad)
        if len(rows):
            found[name] = slice(max(0, int(rows[0]) - _AROUND), int(rows[-1]) + 1 + _AROUND)
    return found


def _damaged(name: str, rows: slice) -> Finding:
    text = f"{name}: rows {rows.start + 1} to {rows.stop} hold values beyond those that the file notes: it is damaged "
    return Finding("damaged", f"{text}there; they were ignored, copy the file again", rows.stop - rows.start)


def is_dataset(path: Path) -> bool:
    """Whether a folder is a dataset of LeRobot."""
    return (path / "meta" / "info.json").is_file() and (path / "data").is_dir()


def dataset_files(path: Path) -> list[Path]:
    """The Parquet files of a dataset of LeRobot, in the order of its episodes; raises RunError without one."""
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise RunError(f"{path}: is a LeRobot dataset without data; wanted data/chunk-000/*.parquet")
    if len(files) > _MAX_FILES:
        raise RunError(f"{path}: has {len(files)} files of data, wanted at most {_MAX_FILES}; name one of them")
    return files


def read_dataset(path: Path, wanted: Sequence[str]) -> Table:
    """Reads the wanted columns of all episodes of a LeRobot dataset; each episode is a segment."""
    tables = []
    for file in dataset_files(path):
        with open_parquet(file) as opened:
            episodes = _EPISODE in opened.schema_arrow.names
        table = read_parquet_table(file, [*wanted, *((_EPISODE,) if episodes and _EPISODE not in wanted else ())])
        tables.append(table)
    number = np.concatenate([table.columns.get(_EPISODE, np.zeros(len(table))) for table in tables])
    file_of_row = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
    begins = np.append(False, (np.diff(number) != 0.0) | (np.diff(file_of_row) != 0))
    columns = {name: np.concatenate([table.columns[name] for table in tables]) for name in wanted}
    findings = tuple(item for table in tables for item in table.findings)
    return Table(columns, findings, np.cumsum(begins[: len(number)]), tables[0].timed)


def _cells(path: Path, name: str, column: pyarrow.ChunkedArray) -> Cells:
    found = numbers_of_column(column)
    if found is None:
        raise RunError(f"{path}: column '{name}': got {column.type}, wanted numbers")
    return found


def _element(path: Path, name: str, column: pyarrow.ChunkedArray, place: int) -> pyarrow.ChunkedArray:
    """One element of each list; null where a list is too short."""
    from pyarrow import compute, types

    kind = column.type
    if not (types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)):
        raise RunError(f"{path}: column '{name}': got {kind}, wanted a column of lists")
    return compute.list_flatten(compute.list_slice(column, place, place + 1, return_fixed_size_list=True))


def open_parquet(path: Path) -> ParquetFile:
    """Opens the file and reads its footer; raises LimitError for a passed limit, and the errors of pyarrow."""
    from pyarrow import parquet

    size = path.stat().st_size
    if size > limit("table_bytes"):
        raise too_much("table_bytes", f"{size} bytes", str(path))
    most = limit("parquet_footer_bytes")
    footer = _footer_bytes(path, size)
    if footer > most:
        raise too_much("parquet_footer_bytes", f"{footer} bytes", str(path))
    file = parquet.ParquetFile(
        path, thrift_string_size_limit=most, thrift_container_size_limit=100_000, page_checksum_verification=True
    )
    if file.metadata.num_columns > limit("columns"):
        raise too_much("columns", file.metadata.num_columns, str(path))
    return file


def _footer_bytes(path: Path, size: int) -> int:
    """Length of the footer, which is stored before the last four bytes; 0 if the file is too short.

    Raises RunError if the file does not end as a Parquet file.
    """
    with path.open("rb") as file:
        file.seek(max(0, size - 8))
        length, magic = file.read(4), file.read(4)
    if magic not in _MAGIC:
        raise RunError(
            f"{path}: is a Parquet file without its end: it is cut off after {size} bytes, and nothing can be read; "
            "copy it again"
        )
    return int.from_bytes(length, "little") if size >= 12 else 0


def _check_size(path: Path, file: ParquetFile, wanted: int) -> None:
    """Raises LimitError if the data of ``wanted`` columns would expand too much."""
    size, about = path.stat().st_size, file.metadata
    most = max(limit("expansion_free_bytes"), size * limit("expansion"))
    expanded = _NUMBER_BYTES * about.num_rows * wanted
    for group in range(about.num_row_groups):  # not per column: pyarrow aborts the process if a column is inconsistent
        expanded += about.row_group(group).total_byte_size // 8
    if about.num_rows < 0 or expanded > most:
        raise too_much("expansion", expanded // max(1, size), str(path))
    allow_for(expanded)
