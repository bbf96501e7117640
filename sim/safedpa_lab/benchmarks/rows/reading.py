"""Reading of logs in a process of its own, with limits, compared with reading in the caller's process."""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path

from safedpa.records import ColumnMap, load_run
from safedpa.records.column_map.file import parse_column_map
from safedpa.records.readers.own_process import in_this_process
from safedpa.robots.car.system import CAR
from safedpa_lab.benchmarks.results import Effort, Entry, Row, Target
from safedpa_lab.log_faults.drive import Drive, Table, Topics, drive_of
from safedpa_lab.log_faults.write import topic_map, write_table, write_topics

_MOST_RATIO = 1.1
_START = 1_700_000_000.0
"""s since 1970, of the messages."""


def measure(effort: Effort) -> Row:
    """Reads drives at 100 Hz as CSV, Parquet and MCAP, in turn in both ways; the first turn is not counted."""
    rows, turns = effort.of(2_000, 72_000, 360_000), effort.of(3, 7)
    drive = drive_of(1, rows)
    drive.values[:, 0] *= 0.2  # drives of the faults have 20 Hz
    ours, peers, targets = [], [], []
    with tempfile.TemporaryDirectory(prefix="safedpa-reading-") as folder:
        for path, columns in _logs(drive, Path(folder)):
            own, direct = _in_turn(path, columns, turns)
            form = path.suffix.removeprefix(".")
            ours.append(Entry("own process", {"seconds": statistics.median(own)}, "s", problem=form))
            peers.append(Entry("caller's process", {"seconds": statistics.median(direct)}, "s", problem=form))
            ratio = statistics.median(a / b for a, b in zip(own, direct, strict=True))
            targets.append(
                Target(f"{form}: own process over the caller's, median of {turns} pairs", _MOST_RATIO, ratio, "")
            )
    work = f"reading of {rows / 6000.0:.3g} min at 100 Hz, from a file to a run"
    return Row("reading", work, "seconds", tuple(ours), tuple(peers), tuple(targets))


def _logs(drive: Drive, folder: Path) -> list[tuple[Path, ColumnMap | None]]:
    logs: list[tuple[Path, ColumnMap | None]] = []
    for suffix in ("csv", "parquet"):
        logs.append((folder / f"drive.{suffix}", None))
        write_table(Table.of(drive), logs[-1][0])
    topics = Topics.of(drive, _START)
    logs.append((folder / "drive.mcap", parse_column_map(topic_map(topics, "mcap"))))
    write_topics(topics, drive, logs[-1][0])
    return logs


def _in_turn(path: Path, columns: ColumnMap | None, turns: int) -> tuple[list[float], list[float]]:
    own, direct = [], []
    for _ in range(turns + 1):
        began = time.perf_counter()
        load_run(path, CAR, columns)
        between = time.perf_counter()
        with in_this_process():
            load_run(path, CAR, columns)
        own.append(between - began)
        direct.append(time.perf_counter() - between)
    return own[1:], direct[1:]
