"""Runs to CSV and Parquet, under the native column names."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safedpa.records.atomic import atomic_path
from safedpa.records.run import Run

if TYPE_CHECKING:
    import pyarrow

__all__ = ["run_columns", "write_columns", "write_csv", "write_parquet"]


def write_csv(run: Run, path: str | Path) -> None:
    """The run as CSV, every digit kept, the rows outside all stretches left out. Raises RecordingError."""
    write_columns(run_columns(run), Path(path), "csv")


def write_parquet(run: Run, path: str | Path) -> None:
    """The run as Parquet, the rows outside all stretches left out. Raises RecordingError."""
    write_columns(run_columns(run), Path(path), "parquet")


def run_columns(run: Run) -> dict[str, Any]:
    """Columns by native name: t, states, actions, of the rows within stretches."""
    parts = list(run.parts())
    t, states, actions = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    columns = {"t": t}
    columns |= {name: states[:, index] for index, name in enumerate(run.system.state_names)}
    columns |= {name: actions[:, index] for index, name in enumerate(run.system.action_names)}
    return columns


def write_columns(columns: Mapping[str, Any], path: Path, kind: str) -> None:
    """Writes columns of equal length as ``csv`` or ``parquet``, whole or not at all. Raises RecordingError."""
    import pyarrow

    table = pyarrow.table(dict(columns))
    with atomic_path(path) as temporary:
        (_write_csv if kind == "csv" else _write_parquet)(table, temporary)


def _write_csv(table: pyarrow.Table, path: Path) -> None:
    from pyarrow import csv

    # Without quotes: names and statuses hold no comma, and every program reads such a file.
    csv.write_csv(table, path, csv.WriteOptions(quoting_style="none", quoting_header="none"))


def _write_parquet(table: pyarrow.Table, path: Path) -> None:
    from pyarrow import parquet

    parquet.write_table(table, path)
