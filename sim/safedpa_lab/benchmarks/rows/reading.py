"""Reading of logs in a process of its own, with limits, compared with reading in the caller's process."""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

from safedpa.records import ColumnMap, load_run
from safedpa.records.column_map.file import parse_column_map
from safedpa.records.readers.own_process import in_this_process, reader_seconds
from safedpa.robots.car.system import CAR
from safedpa_lab.benchmarks.results import Effort, Entry, Row, Target
from safedpa_lab.log_faults.drive import Drive, Table, Topics, drive_of
from safedpa_lab.log_faults.write import topic_map, write_table, write_topics

_Seconds = tuple[float, float]
"""Wall and processor time."""
_MOST_RATIO = 1.1
_FINER = 5
"""Rows at 100 Hz for each of a drive, which has 20 Hz."""
_START = 1_700_000_000.0
"""s since 1970, of the messages."""


def measure(effort: Effort) -> Row:
    """Reads drives at 100 Hz as CSV, Parquet and MCAP, in turn in both ways; the first turn is not counted."""
    rows, turns = effort.of(2_000, 72_000, 360_000), effort.of(3, 7)
    drive = _finer(drive_of(1, rows // _FINER))
    ours: list[Entry] = []
    peers: list[Entry] = []
    targets = []
    with tempfile.TemporaryDirectory(prefix="safedpa-reading-") as folder:
        for path, columns in _logs(drive, Path(folder)):
            pairs = _in_turn(path, columns, turns)
            form = path.suffix.removeprefix(".")
            for entries, name, side in ((ours, "own process", 0), (peers, "caller's process", 1)):
                wall, busy = (statistics.median(pair[side][kind] for pair in pairs) for kind in (0, 1))
                entries.append(Entry(name, {"seconds": wall}, "s", {"seconds": busy}, problem=form))
            for kind, what in enumerate(("wall", "processor")):
                ratio = statistics.median(own[kind] / direct[kind] for own, direct in pairs)
                text = f"{form}: {what} time in an own process over the caller's, median of {turns} pairs"
                targets.append(Target(text, _MOST_RATIO, ratio, ""))
    work = f"reading of {rows / 6000.0:.3g} min at 100 Hz, from a file to a run"
    return Row("reading", work, "seconds", tuple(ours), tuple(peers), tuple(targets))


def _finer(drive: Drive) -> Drive:
    """The same drive at 100 Hz: straight between its rows."""
    rows = np.linspace(0.0, len(drive) - 1.0, _FINER * (len(drive) - 1) + 1)
    return Drive(np.column_stack([np.interp(rows, np.arange(len(drive)), column) for column in drive.values.T]))


def _logs(drive: Drive, folder: Path) -> list[tuple[Path, ColumnMap | None]]:
    logs: list[tuple[Path, ColumnMap | None]] = []
    for suffix in ("csv", "parquet"):
        logs.append((folder / f"drive.{suffix}", None))
        write_table(Table.of(drive), logs[-1][0])
    topics = Topics.of(drive, _START)
    logs.append((folder / "drive.mcap", parse_column_map(topic_map(topics, "mcap"))))
    write_topics(topics, drive, logs[-1][0])
    return logs


def _in_turn(path: Path, columns: ColumnMap | None, turns: int) -> list[tuple[_Seconds, _Seconds]]:
    """Wall and processor time in a process of its own, and in this one, in each turn."""
    found = []
    for _ in range(turns + 1):
        own = _timed(path, columns)
        with in_this_process():
            found.append((own, _timed(path, columns)))
    return found[1:]


def _timed(path: Path, columns: ColumnMap | None) -> _Seconds:
    began, busy, reader = time.perf_counter(), time.process_time(), reader_seconds()
    load_run(path, CAR, columns)
    return time.perf_counter() - began, time.process_time() - busy + reader_seconds() - reader
