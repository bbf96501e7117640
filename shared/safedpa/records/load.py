"""One door for every recording: CSV, Parquet or MCAP to a run in SI units, with its bad stretches cut."""

from __future__ import annotations

from pathlib import Path

from safedpa.errors import RunError
from safedpa.records.apply_map import Rows, check_map, derive_states, keep_rows, mapped_rows
from safedpa.records.column_map import ColumnMap, native_map
from safedpa.records.quality import judged
from safedpa.records.run import Finding, Run
from safedpa.records.table import Table, require_file
from safedpa.systems import System

__all__ = ["load_run", "run_of_rows"]


def load_run(path: str | Path, system: System, columns: ColumnMap | None = None) -> Run:
    """The run in a file: .csv, .parquet or .mcap by its ending, by its content when it has none of these.

    Without a column map the columns carry the native names: ``t`` [s] and those of the system's states and actions.
    Time starts at 0 with the first row. Raises RunError when the file cannot be used, with all findings when no stretch
    of it can, and ColumnMapError when the map does not fit the system.
    """
    path = Path(path)
    mapping = native_map(system) if columns is None else columns
    check_map(mapping, system)
    require_file(path)
    kind = _kind(path)
    table = _read(path, kind, mapping)
    return run_of_rows(path, system, mapping, mapped_rows(table, mapping, system), table.findings)


def run_of_rows(path: Path, system: System, mapping: ColumnMap, rows: Rows, findings: tuple[Finding, ...]) -> Run:
    """The run that the rows of a file make: judged, cut, derived, thinned; raises RunError when nothing is left."""
    if not len(rows.t):
        raise RunError(f"{path}: no rows" + _listed(findings) + "; wanted at least two")
    rows, stretches, found = judged(rows, mapping, system)
    rows, stretches, derived = derive_states(rows, stretches, mapping, system)
    if mapping.keep_period is not None:
        rows, stretches = keep_rows(rows, stretches, mapping.keep_period)
    every = (*findings, *found, *derived)
    if not stretches:
        raise RunError(f"{path}: no usable stretch of rows" + _listed(every))
    return Run(path.stem, system, rows.t, rows.states, rows.actions, tuple(stretches), every)


def _listed(findings: tuple[Finding, ...]) -> str:
    return ": " + "; ".join(finding.message for finding in findings) if findings else ""


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
