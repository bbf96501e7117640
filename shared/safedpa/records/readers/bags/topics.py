"""Logs of topics in any format: their topics, series of selected fields, and one table of several topics.

The table has a row for each message of one topic, with the latest values of the other topics.
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
"""Clocks of a topic, used in place of a field path: time of receipt by the recorder; stamp in the message header; the
stamp if there is one, else the receipt."""
_CLOCKS = (RECEIPT, HEADER, STAMP)


@dataclass(frozen=True)
class LoggedTopic:
    """One topic of a log."""

    name: str
    type: str
    count: int
    first: int
    """Receipt time of the first message, ns; 0 for a topic without messages."""
    last: int
    fields: Mapping[str, str] = field(default_factory=dict)
    """Type by path of every field that can become a column; empty if the message type is unknown."""
    problem: str = ""
    """Why the topic cannot be read; empty if it can."""

    @property
    def rate(self) -> float:
        """Messages per second; 0 for fewer than two messages."""
        return (
            (self.count - 1) / ((self.last - self.first) * 1e-9) if self.count > 1 and self.last > self.first else 0.0
        )


@dataclass(frozen=True)
class Series:
    """Selected fields of one topic, sorted by receipt time."""

    receipt: NDArray[np.int64]
    """Receipt times, shape (messages,), ns."""
    stamp: NDArray[np.int64] | None
    """Time stamps in the messages, shape (messages,), ns; None if they have none or only zeros."""
    values: Mapping[str, NDArray[np.float64]]
    """Values by path, shape (messages,); NaN if an array in the message was too short."""
    frames: Mapping[str, frozenset[str]] = field(default_factory=dict)
    """Frame names by field: ``header.frame_id`` and ``child_frame_id``, if the message has them."""


class AbstractLog(ABC):
    """A log of topics, each with its own fields and rate."""

    def __init__(self, path: Path, kind: str) -> None:
        self.path, self.kind = path, kind
        self.findings: list[Finding] = []

    @abstractmethod
    def topics(self) -> Mapping[str, LoggedTopic]:
        """Every topic by name; raises RunError if the file cannot be read."""

    @abstractmethod
    def series(self, wanted: Mapping[str, tuple[str, ...]]) -> Mapping[str, Series]:
        """Reads fields of topics; raises RunError for a missing topic and InputError for a missing field."""

    def topic(self, name: str) -> LoggedTopic:
        """Returns one topic; raises RunError that lists the topics of the log if it is missing or empty."""
        known = self.topics()
        shown = readable(name)
        if name not in known:
            hint = readable(did_you_mean(name, known), 600)
            raise RunError(f"{self.path}: topic '{shown}' does not exist; {hint}")
        if not known[name].count:
            raise RunError(f"{self.path}: topic '{shown}' has no message; record it, or leave it out of the map")
        return known[name]


def split_source(source: str) -> tuple[str, str]:
    """Splits ``/odom:pose.pose.position.x`` into (topic, path); the topic is empty if the column names none."""
    topic, _, path = source.rpartition(":")
    return topic, path


HOLD_ACTION = 0.5
"""s; default for the age up to which a command counts as still applied."""
_HOLD_STATE = 0.1
"""s; default for the age up to which a measurement of another topic is used."""
_MAX_CLOCK_OFFSET = 0.5
"""s; beyond it two clocks are taken for those of two computers, whose messages cannot be ordered."""


def read_log_table(log: AbstractLog, columns: ColumnMap, system: System) -> Table:
    """Reads the columns of a map from a log of topics, with a row for each message of the topic that gives the time.

    For another topic a row has the latest value that is no older than the column's ``hold``, else NaN; nothing is
    interpolated. Raises RunError if the log lacks a topic or field, or if clocks or frames do not match the map.
    """
    wanted = _fields_by_topic(log, columns)
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
    for source, hold in _max_ages(columns, system).items():
        topic, path = split_source(source)
        if path in _CLOCKS:
            table[source] = times[topic] / 1e9
            continue
        values = found[topic].values[path]
        if topic == rows_topic:
            table[source] = values
        else:
            table[source], new_findings = _hold_newest(source, rows, times[topic], values, hold)
            findings += new_findings
    return Table(table, tuple(findings))


def _fields_by_topic(log: AbstractLog, columns: ColumnMap) -> dict[str, tuple[str, ...]]:
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


def _max_ages(columns: ColumnMap, system: System) -> dict[str, float]:
    """Maximum age [s] of each source column on a row of another topic."""
    holds: dict[str, float] = {}
    for target, column in columns.columns.items():
        if isinstance(column, SourceColumn):
            usual = HOLD_ACTION if target in system.action_names else _HOLD_STATE
            for source in column.sources:
                holds[source] = usual if column.hold is None else column.hold
    return {**{rule.column: HOLD_ACTION for rule in columns.skip_where}, **holds}


def _times(series: Series, clock: str) -> NDArray[np.int64]:
    """Time of each message, ns: its stamp, or its receipt if requested or without a stamp."""
    return series.receipt if clock == RECEIPT or series.stamp is None else series.stamp


def _receipt_delay(series: Series) -> float:
    """Median time from stamp to receipt, s; 0 without stamps."""
    return 0.0 if series.stamp is None else float(np.median(series.receipt - series.stamp)) * 1e-9


def _clock_findings(
    log: AbstractLog, found: Mapping[str, Series], times: Mapping[str, NDArray[np.int64]], rows_topic: str
) -> list[Finding]:
    rows = found[rows_topic]
    if times[rows_topic] is rows.receipt or rows.stamp is None:
        return []
    delay = _receipt_delay(rows)
    for topic, series in found.items():
        own = 0.0 if times[topic] is series.receipt else _receipt_delay(series)
        if abs(delay - own) > _MAX_CLOCK_OFFSET:  # 0 for the topic of the rows
            raise RunError(
                f"{log.path}: stamps of '{rows_topic}' and times of '{topic}' are {abs(delay - own):.3g} s apart:"
                ' two clocks, or a replayed log; wanted one clock: t = { topic = "'
                f'{rows_topic}", clock = "receipt" }}'
            )
    if abs(delay) < 1e-4:
        return []
    sentence = f"times are the stamps of {rows_topic}; they were received {delay * 1000:.1f} ms later (median)"
    return [Finding("stamps", sentence, len(rows.receipt))]


def _hold_newest(
    source: str, rows: NDArray[np.int64], times: NDArray[np.int64], values: NDArray[np.float64], hold: float
) -> tuple[NDArray[np.float64], list[Finding]]:
    """Latest value at each row; NaN if it is older than ``hold`` [s] or if there is none yet."""
    order = np.argsort(times, kind="stable")
    times, values = times[order], values[order]
    newest = np.searchsorted(times, rows, side="right") - 1
    age = (rows - times[np.maximum(newest, 0)]) / 1e9
    recent = (newest >= 0) & (age <= hold)
    taken = np.where(recent, values[np.maximum(newest, 0)], np.nan)
    topic = split_source(source)[0]
    old = int((~recent).sum())
    if not old:
        return taken, []
    first = float(rows[int(np.flatnonzero(~recent)[0])]) / 1e9
    how = "a row" if old == 1 else f"{old} rows"
    sentence = (
        f"{topic} sent nothing for more than {hold:g} s before {how} of {len(rows)}; cut. 'hold' in the map allows more"
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
                    f"{log.path}: topic '{topic}': {which} is {notice}, wanted '{name}' as the map says; name a topic "
                    "in that frame, or correct [frames]"
                )
