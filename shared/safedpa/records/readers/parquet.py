"""Reads Parquet files as tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from safedpa.errors import RunError
from safedpa.limits import limit, too_much
from safedpa.records.readers.table import Table, require_columns, require_file

if TYPE_CHECKING:
    from pyarrow.parquet import ParquetFile

__all__ = ["open_parquet", "read_parquet_table"]

_NUMBER_BYTES = 8


def read_parquet_table(path: Path, wanted: Sequence[str]) -> Table:
    """Reads the wanted columns of a Parquet file.

    Raises RunError if it is not a Parquet file, or if a column is missing or not numeric.
    """
    import pyarrow

    require_file(path)
    try:
        with open_parquet(path) as file:
            present = list(file.schema_arrow.names)
            require_columns(path, wanted, present)
            _check_wanted(path, file, wanted)
            table = file.read(columns=list(wanted))
    except (pyarrow.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise RunError(f"{path}: cannot be read as Parquet ({reason}); it may be cut off or another format") from error
    # safe=False: ns since 1970 exceed the 53 bits of a float64, so times are rounded to 256 ns, as in all logs
    numbers = {name: table.column(name).cast(pyarrow.float64(), safe=False) for name in wanted}
    return Table({name: np.asarray(column.to_numpy(), dtype=np.float64) for name, column in numbers.items()})


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
    file = parquet.ParquetFile(path, thrift_string_size_limit=most, thrift_container_size_limit=100_000)
    if file.metadata.num_columns > limit("columns"):
        raise too_much("columns", file.metadata.num_columns, str(path))
    return file


def _footer_bytes(path: Path, size: int) -> int:
    """Length of the footer, which is stored before the last four bytes; 0 if the file is too short."""
    with path.open("rb") as file:
        file.seek(max(0, size - 8))
        return int.from_bytes(file.read(8)[:4], "little") if size >= 12 else 0


def _check_wanted(path: Path, file: ParquetFile, wanted: Sequence[str]) -> None:
    """Raises RunError for a column without numbers, and LimitError if the data would expand too much."""
    import pyarrow

    for name in wanted:
        kind = file.schema_arrow.field(name).type
        if not (pyarrow.types.is_floating(kind) or pyarrow.types.is_integer(kind) or pyarrow.types.is_boolean(kind)):
            raise RunError(f"{path}: column '{name}': got {kind}, wanted numbers")
    size, about = path.stat().st_size, file.metadata
    most = max(limit("expansion_free_bytes"), size * limit("expansion"))
    expanded = _NUMBER_BYTES * about.num_rows * len(wanted)
    for group in range(about.num_row_groups):  # not per column: pyarrow aborts the process if a column is inconsistent
        expanded += about.row_group(group).total_byte_size // 8
    if about.num_rows < 0 or expanded > most:
        raise too_much("expansion", expanded // max(1, size), str(path))
