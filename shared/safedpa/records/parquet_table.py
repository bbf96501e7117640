"""Parquet files as tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from safedpa.errors import RunError
from safedpa.records.table import Table, require_columns, require_file

__all__ = ["read_parquet_table"]


def read_parquet_table(path: Path, wanted: Sequence[str]) -> Table:
    """The wanted columns of a Parquet file.

    Raises RunError when it is no Parquet file, or a column is missing or holds no numbers.
    """
    import pyarrow
    from pyarrow import parquet

    require_file(path)
    try:
        present = list(parquet.read_schema(path).names)
        require_columns(path, wanted, present)
        table = parquet.read_table(path, columns=list(wanted))
    except (pyarrow.ArrowInvalid, OSError) as error:
        raise RunError(f"{path}: cannot be read as Parquet ({error}); it may be cut off or another format") from error
    columns = {}
    for name in wanted:
        kind = table.schema.field(name).type
        if not (pyarrow.types.is_floating(kind) or pyarrow.types.is_integer(kind) or pyarrow.types.is_boolean(kind)):
            raise RunError(f"{path}: column '{name}': got {kind}, wanted numbers")
        columns[name] = np.asarray(table.column(name).cast(pyarrow.float64()).to_numpy(), dtype=np.float64)
    return Table(columns)
