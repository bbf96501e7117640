"""What a log of topics holds, whatever its format: topics, and series of chosen fields.

Topics of different rates become one table: the rows of one topic, and next to each what the others said last.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import ColumnMapError, RunError, did_you_mean
from safedpa.limits import readable
from safedpa.records.column_map.column_map import ColumnMap, SourceColumn
from safedpa.records.readers.table import Table
from safedpa.records.run import Finding
from safedpa.systems import System

__all__ = [
    "HEADER",
    "HOLD_ACTION",
    "RECEIPT",
    "STAMP",
    "AbstractLog",
    "LoggedTopic",
    "Series",
    "read_log_table",
    "split_source",
]

RECEIPT, HEADER, STAMP = "@receipt", "@header", "@stamp"
"""Clocks of a topic, written where a field's path would stand: when the recorder received a message; the message's own
time stamp; the stamp where there is one, else the receipt."""
_CLOCKS = (RECEIPT, HEADER, STAMP)


@dataclass(frozen=True)
class LoggedTopic:
    """One topic of a log."""

    name: str
    type: str
    count: int
    first: int
    """ns, of the recorder's clock; 0 of a topic without messages."""
    last: int
    fields: Mapping[str, str] = field(default_factory=dict)
    """Path to type of what can become a column; empty where the type is not known."""
    problem: str = ""
    """Why it cannot be read."""

    @property
    def rate(self) -> float:
        """Messages per second; 0 of fewer than two."""
        return (
            (self.count - 1) / ((self.last - self.first) * 1e-9) if self.count > 1 and self.last > self.first else 0.0
        )


@dataclass(frozen=True)
class Series:
    """Messages of one topic in the order of the recorder's clock."""

    receipt: NDArray[np.int64]
    """(messages,) ns."""
    stamp: NDArray[np.int64] | None
    """(messages,) ns; None where the messages carry none, or only zeros."""
    values: Mapping[str, NDArray[np.float64]]
    """(messages,) by path; NaN where a sequence was too short."""
    frames: Mapping[str, frozenset[str]] = field(default_factory=dict)
    """What ``header.frame_id`` and ``child_frame_id`` say, where they are there."""


class AbstractLog(ABC):
    """A log whose numbers come by topic and field, each topic at a rate of its own."""

    def __init__(self, path: Path, kind: str) -> None:
        self.path, self.kind = path, kind
        self.findings: list[Finding] = []

    @abstractmethod
    def topics(self) -> Mapping[str, LoggedTopic]:
        """Every topic, by name. Raises RunError for a file that cannot be read at all."""

    @abstractmethod
    def series(self, wanted: Mapping[str, tuple[str, ...]]) -> Mapping[str, Series]:
        """Fields of topics. Raises RunError for a topic that is not there, InputError for a field that is not."""

    def topic(self, name: str) -> LoggedTopic:
        """One topic. Raises RunError naming those that are there."""
        known = self.topics()
        shown = readable(name)
        if name not in known:
            hint = readable(did_you_mean(name, known), 600)
            raise RunError(f"{self.path}: topic '{shown}' is not there; {hint}")
        if not known[name].count:
            raise RunError(f"{self.path}: topic '{shown}' has no message; record it, or leave it out of the map")
        return known[name]


def split_source(source: str) -> tuple[str, str]:
    """(topic, path) of ``/odom:pose.pose.position.x``; the topic is empty of a column that names none."""
    topic, _, path = source.rpartition(":")
    return topic, path


HOLD_ACTION = 0.5
"""s; how old a command may be that is still in force, unless a column's ``hold`` says otherwise."""
_HOLD_STATE = 0.1
"""s; how old what another topic measured may be."""
_CLOCKS_APART = 0.5
"""s; farther apart two clocks are two computers', and messages of both cannot be put in order."""


def read_log_table(log: AbstractLog, columns: ColumnMap, system: System) -> Table:
    """The columns of a map out of a log of topics; a row for each message of the topic that gives the time.

    Of another topic a row holds the newest message that is no older than the column's ``hold``, else NaN: nothing is
    interpolated. Raises RunError naming what the log lacks, and where clocks or frames are not what was asked for.
    """
    wanted = _wanted(log, columns)
    at = columns.columns["t"]
    assert isinstance(at, SourceColumn)
    rows_topic, clock = split_source(at.source)
    found = log.series({topic: tuple(path for path in paths if path not in _CLOCKS) for topic, paths in wanted.items()})
    _check_frames(log, columns, found)
    if clock == HEADER and found[rows_topic].stamp is None:
        raise RunError(f"{log.path}: topic '{rows_topic}' has no time stamps; take clock = \"receipt\" for t")
    times = {topic: _times(series, clock) for topic, series in found.items()}
    findings = [*log.findings, *_clock_findings(log, found, times, rows_topic)]
    rows = times[rows_topic]
    table: dict[str, NDArray[np.float64]] = {}
    for source, hold in _holds(columns, system).items():
        topic, path = split_source(source)
        if path in _CLOCKS:
            table[source] = times[topic] / 1e9
            continue
        values = found[topic].values[path]
        if topic == rows_topic:
            table[source] = values
        else:
            table[source], reported = _held(source, rows, times[topic], values, hold)
            findings += reported
    return Table(table, tuple(findings))


def _wanted(log: AbstractLog, columns: ColumnMap) -> dict[str, tuple[str, ...]]:
    wanted: dict[str, list[str]] = {}
    for source in columns.sources:
        topic, path = split_source(source)
        if not topic:
            raise RunError(
                f"{log.path}: is a {log.kind}, and the map's column '{source}' names no topic; wanted "
                f'{{ topic = "/odom", field = "..." }}: \'safedpa columns {log.path}\' proposes a map'
            )
        wanted.setdefault(topic, []).append(path)
    return {topic: tuple(paths) for topic, paths in wanted.items()}


def _holds(columns: ColumnMap, system: System) -> dict[str, float]:
    """Every raw column with the age [s] that it may reach on a row of another topic."""
    holds: dict[str, float] = {}
    for target, column in columns.columns.items():
        if isinstance(column, SourceColumn):
            usual = HOLD_ACTION if target in system.action_names else _HOLD_STATE
            for source in column.sources:
                holds[source] = usual if column.hold is None else column.hold
    return {**{rule.column: HOLD_ACTION for rule in columns.skip_where}, **holds}


def _times(series: Series, clock: str) -> NDArray[np.int64]:
    """ns; when each message counts: its own stamp unless the receipts were asked for, or it has none."""
    return series.receipt if clock == RECEIPT or series.stamp is None else series.stamp


def _late(series: Series) -> float:
    """s; the median time from a message's stamp to its receipt."""
    return 0.0 if series.stamp is None else float(np.median(series.receipt - series.stamp)) * 1e-9


def _clock_findings(
    log: AbstractLog, found: Mapping[str, Series], times: Mapping[str, NDArray[np.int64]], rows_topic: str
) -> list[Finding]:
    rows = found[rows_topic]
    if times[rows_topic] is rows.receipt or rows.stamp is None:
        return []
    late = _late(rows)
    for topic, series in found.items():
        own = 0.0 if times[topic] is series.receipt else _late(series)
        if abs(late - own) > _CLOCKS_APART:  # of the rows' own topic it is 0
            raise RunError(
                f"{log.path}: stamps of '{rows_topic}' and times of '{topic}' are {abs(late - own):.3g} s apart:"
                ' two clocks, or a log that was played again; wanted one clock: t = { topic = "'
                f'{rows_topic}", clock = "receipt" }}'
            )
    if abs(late) < 1e-4:
        return []
    sentence = f"times are the stamps of {rows_topic}; the recorder's clock says {late * 1000:.1f} ms later (median)"
    return [Finding("stamps", sentence, len(rows.receipt))]


def _held(
    source: str, rows: NDArray[np.int64], times: NDArray[np.int64], values: NDArray[np.float64], hold: float
) -> tuple[NDArray[np.float64], list[Finding]]:
    """The newest value at each row, NaN where it is older than ``hold`` [s] or none came yet."""
    order = np.argsort(times, kind="stable")
    times, values = times[order], values[order]
    newest = np.searchsorted(times, rows, side="right") - 1
    age = (rows - times[np.maximum(newest, 0)]) / 1e9
    fresh = (newest >= 0) & (age <= hold)
    taken = np.where(fresh, values[np.maximum(newest, 0)], np.nan)
    topic = split_source(source)[0]
    old = int((~fresh).sum())
    if not old:
        return taken, []
    first = float(rows[int(np.flatnonzero(~fresh)[0])]) / 1e9
    how = "a row" if old == 1 else f"{old} rows"
    sentence = (
        f"{topic} said nothing for more than {hold:g} s before {how} of {len(rows)}; cut. 'hold' in the map allows more"
    )
    return taken, [Finding("stale_topic", sentence, old, first)]


def _check_frames(log: AbstractLog, columns: ColumnMap, found: Mapping[str, Series]) -> None:
    for topic, wanted in columns.frames.items():
        if topic not in found:
            raise ColumnMapError(f"{columns.name}: frames: no column is of topic '{topic}'; remove the entry")
        for which, name in wanted.items():
            key = "header.frame_id" if which == "frame_id" else which
            got = found[topic].frames.get(key)
            if got is None:
                raise RunError(f"{log.path}: topic '{topic}' has no {which}; remove it from [frames] of the map")
            if {one.strip("/") for one in got} != {name.strip("/")}:
                notice = ", ".join(f"'{one}'" for one in sorted(got))
                raise RunError(
                    f"{log.path}: topic '{topic}': {which} is {notice}, wanted '{name}' as the map says; name a topic in "
                    "that frame, or correct [frames]"
                )
