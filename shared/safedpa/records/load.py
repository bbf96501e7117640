"""One door for every recording: CSV, Parquet or MCAP to a run in SI units, with its bad stretches cut."""

from __future__ import annotations

from pathlib import Path

from safedpa.errors import ColumnMapError
from safedpa.records.apply_map import check_map, mapped_rows
from safedpa.records.column_map import ColumnMap, native_map
from safedpa.records.run import Run
from safedpa.records.run_of_rows import run_of_rows
from safedpa.records.table import Table, require_file
from safedpa.systems import System

__all__ = ["load_run"]


def load_run(path: str | Path, system: System, columns: ColumnMap | None = None) -> Run:
    """The run in a file: .csv, .parquet or .mcap by its ending, by its content when it has none of these.

    Without a column map the columns carry the native names: ``t`` [s] and those of the system's states and actions.
    Time is that of the file. Raises RunError when the file cannot be used, with all findings when no stretch
    of it can, and ColumnMapError when the map does not fit the system.
    """
    path = Path(path)
    mapping = native_map(system) if columns is None else columns
    check_map(mapping, system)
    require_file(path)
    kind = _kind(path)
    if kind == "mcap":
        if columns is not None:
            raise ColumnMapError(f"{columns.name}: {path} is a recording of the bus; leave the column map out")
        from safedpa.records.mcap_run import read_run_from_mcap

        return read_run_from_mcap(path, system)
    table = _read(path, kind, mapping)
    return run_of_rows(path, system, mapping, mapped_rows(table, mapping, system), table.findings)


def _kind(path: Path) -> str:
    suffix = path.suffix.lower().lstrip(".")
    if suffix in ("csv", "parquet", "mcap"):
        return suffix
    with path.open("rb") as file:
        start = file.read(8)
    if start.startswith(b"\x89MCAP"):
        return "mcap"
    return "parquet" if start.startswith(b"PAR1") else "csv"


def _read(path: Path, kind: str, mapping: ColumnMap) -> Table:
    if kind == "parquet":
        from safedpa.records.parquet_table import read_parquet_table

        return read_parquet_table(path, mapping.sources)
    from safedpa.records.csv_table import read_csv_table

    return read_csv_table(path, mapping.sources)
