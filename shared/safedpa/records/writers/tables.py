"""Writes runs and bus recordings as CSV or Parquet with the native column names; files are written atomically."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np

from safedpa.disk import why_not_written
from safedpa.errors import RecordingError, RunError
from safedpa.records.readers.mcap import Recording, VerdictRow, read_recording
from safedpa.records.run import Finding, Run
from safedpa.systems import System, systems

if TYPE_CHECKING:
    import pyarrow

__all__ = [
    "ExportResult",
    "atomic_path",
    "export_recording",
    "run_columns",
    "write_columns",
    "write_csv",
    "write_parquet",
]


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yields a temporary path that is renamed to ``path`` at the end, or removed if the block raises.

    Raises RecordingError if the file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{uuid4().hex[:8]}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise RecordingError(
            f"{path}: cannot be written ({why_not_written(error)}); nothing was changed; choose another folder"
        ) from error
    finally:
        with suppress(OSError):  # the folder itself may be missing
            temporary.unlink(missing_ok=True)


def write_csv(run: Run, path: str | Path) -> None:
    """Writes the rows within stretches as CSV in full precision. Raises RecordingError."""
    write_columns(run_columns(run), Path(path), "csv")


def write_parquet(run: Run, path: str | Path) -> None:
    """Writes the rows within stretches as Parquet. Raises RecordingError."""
    write_columns(run_columns(run), Path(path), "parquet")


def run_columns(run: Run) -> dict[str, Any]:
    """Returns the columns t, states and actions by native name, for the rows within stretches."""
    parts = list(run.parts())
    t, states, actions = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    columns = {"t": t}
    columns |= {name: states[:, index] for index, name in enumerate(run.system.state_names)}
    columns |= {name: actions[:, index] for index, name in enumerate(run.system.action_names)}
    return columns


def write_columns(columns: Mapping[str, Any], path: Path, kind: str) -> None:
    """Writes columns of equal length as ``csv`` or ``parquet``, atomically. Raises RecordingError."""
    import pyarrow

    table = pyarrow.table(dict(columns))
    with atomic_path(path) as temporary:
        (_write_csv if kind == "csv" else _write_parquet)(table, temporary)


def _write_csv(table: pyarrow.Table, path: Path) -> None:
    from pyarrow import csv

    # without quotes every program can read the file; names and statuses contain no comma
    csv.write_csv(table, path, csv.WriteOptions(quoting_style="none", quoting_header="none"))


def _write_parquet(table: pyarrow.Table, path: Path) -> None:
    from pyarrow import parquet

    parquet.write_table(table, path)


@dataclass(frozen=True)
class ExportResult:
    """Summary of an export."""

    robot: str
    rows: int
    findings: tuple[Finding, ...]


def export_recording(recording: Path, out: Path, kind: str, robot: str | None = None) -> ExportResult:
    """Writes the ticks of one robot as ``csv`` or ``parquet``, atomically.

    Columns: t [s], states, actions applied until the next row and, if verdicts were recorded, status, slack, h_now,
    h_next and margin (empty at ticks without one). Ticks before a missing one, and the last tick, are omitted: the
    robot reports their action with the next tick. Raises RunError if the recording cannot be used, and RecordingError
    if ``out`` cannot be written.
    """
    ticks = read_recording(recording, robot, with_verdicts=True)
    system = _system_of(recording, ticks)
    known = np.flatnonzero(np.isfinite(ticks.actions).all(axis=1))
    if not len(known):
        raise RunError(f"{recording}: robot '{ticks.robot}' has no two consecutive ticks; wanted a longer recording")
    columns: dict[str, Any] = {"t": ticks.t[known]}
    columns |= {name: ticks.states[known, index] for index, name in enumerate(system.state_names)}
    columns |= {name: ticks.actions[known, index] for index, name in enumerate(system.action_names)}
    if ticks.verdicts:
        columns |= _verdict_columns([ticks.verdicts.get(ticks.stamps[row]) for row in known])
    write_columns(columns, out, kind)
    return ExportResult(ticks.robot, len(known), ticks.findings)


def _system_of(path: Path, ticks: Recording) -> System:
    shape = (ticks.states.shape[1], ticks.actions.shape[1])
    for system in systems().values():
        if shape == (len(system.state), len(system.action)):
            return system
    raise RunError(
        f"{path}: robot '{ticks.robot}' has {shape[0]} states and {shape[1]} actions: no known kind of robot; "
        "SAFEDPA_EFFECTS=FILE.py makes one of your own known"
    )


def _verdict_columns(verdicts: list[VerdictRow | None]) -> dict[str, Any]:
    return {
        name: [None if verdict is None else verdict[place] for verdict in verdicts]
        for place, name in enumerate(("status", "slack", "h_now", "h_next", "margin"))
    }
