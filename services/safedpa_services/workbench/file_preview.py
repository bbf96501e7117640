"""The first rows of a file as they stand in it, and what the reader makes of the whole of it."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from safedpa.errors import RunError, SafedpaError
from safedpa.records import ColumnMap, load_run
from safedpa.systems import System

__all__ = ["Checked", "RawRows", "checked", "raw_rows"]

_DELIMITERS = ",;\t"


@dataclass(frozen=True)
class RawRows:
    """Column names and the first rows of a file, as text; no columns for a recording of the bus."""

    names: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Checked:
    """What the reader says of a recording: its first rows in SI units and its findings, or why it cannot be read."""

    problem: str
    sentence: str
    names: tuple[str, ...]
    rows: tuple[tuple[float, ...], ...]
    findings: tuple[str, ...]


def raw_rows(path: str | Path, count: int = 5) -> RawRows:
    """The first rows of a CSV or Parquet file; raises RunError when it cannot be read."""
    path = Path(path)
    if not path.is_file():
        raise RunError(f"{path}: no such file; wanted a recording (.csv, .parquet or .mcap)")
    try:
        with path.open("rb") as file:
            start = file.read(8)
        if start.startswith(b"\x89MCAP"):
            return RawRows((), ())
        return _parquet(path, count) if start.startswith(b"PAR1") else _csv(path, count)
    except (OSError, UnicodeDecodeError, csv.Error, ValueError) as error:
        raise RunError(f"{path}: cannot be read ({str(error)[:120]}); wanted a table with a header line") from error


def _csv(path: Path, count: int) -> RawRows:
    with path.open(encoding="utf-8-sig", newline="") as file:
        first = file.readline()
        delimiter = max(_DELIMITERS, key=first.count)
        lines = csv.reader([first, *islice(file, count)], delimiter=delimiter)
        header, *rows = [tuple(cell.strip() for cell in line) for line in lines] or [()]
    if not any(header):
        raise RunError(f"{path}: the first line is empty; wanted a header line with the columns' names")
    return RawRows(header, tuple(rows))


def _parquet(path: Path, count: int) -> RawRows:
    from pyarrow import parquet

    table = parquet.ParquetFile(path)
    names = tuple(table.schema_arrow.names)
    batch = next(table.iter_batches(batch_size=count), None)
    columns = [] if batch is None else [[str(cell) for cell in column] for column in batch.to_pydict().values()]
    return RawRows(names, tuple(zip(*columns, strict=True)))


def checked(path: str | Path, system: System, columns: ColumnMap | None, count: int = 5) -> Checked:
    """The recording as the diagnosis would see it; what is wrong with it stands in the answer."""
    names = ("t", *system.state_names, *system.action_names)
    try:
        run = load_run(path, system, columns)
    except SafedpaError as error:
        return Checked(str(error), "", names, (), ())
    rows = tuple(
        (float(run.t[row] - run.t[0]), *map(float, run.states[row]), *map(float, run.actions[row]))
        for row in range(min(count, len(run.t)))
    )
    kept = sum(len(part) for part in run.stretches)
    stretches = "1 stretch" if len(run.stretches) == 1 else f"{len(run.stretches)} stretches"
    sentence = f"{kept} rows in {stretches}, {run.duration:.1f} s, one every {run.period:.4g} s"
    return Checked("", sentence, names, rows, tuple(_messages(run.findings)))


def _messages(findings: Sequence[object]) -> list[str]:
    return list(dict.fromkeys(str(getattr(item, "message", item)) for item in findings))
