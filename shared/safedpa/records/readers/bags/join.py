"""Joins the topics of a log to one table: a row for each message of one topic, with the latest values of the others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import ColumnMapError, RunError
from safedpa.records.column_map.column_map import HOLD_ACTION, HOLD_STATE, ColumnMap, SourceColumn
from safedpa.records.readers.bags.timeline import Placed, place_messages
from safedpa.records.readers.bags.topics import CLOCKS, HEADER, AbstractLog, Series, split_source
from safedpa.records.readers.table import Table
from safedpa.records.run import Finding
from safedpa.systems import System

__all__ = ["read_log_table"]


def read_log_table(log: AbstractLog, columns: ColumnMap, system: System) -> Table:
    """Reads the columns of a map from a log of topics, with a row for each message of the topic that gives the time.

    For another topic a row has the latest value of its segment that is no older than the column's ``hold``, else NaN;
    nothing is interpolated. Raises RunError if the log lacks a topic or field, or if clocks or frames do not match the
    map.
    """
    wanted = _fields_by_topic(log, columns)
    at = columns.columns["t"]
    assert isinstance(at, SourceColumn)
    rows_topic, clock = split_source(at.source)
    found = log.series({topic: tuple(path for path in paths if path not in CLOCKS) for topic, paths in wanted.items()})
    _check_frames(log, columns, found)
    if clock == HEADER and found[rows_topic].stamp is None:
        raise RunError(f"{log.path}: topic '{rows_topic}' has no time stamps; take clock = \"receipt\" for t")
    placed, placing = place_messages(log.path, found, rows_topic, clock)
    findings = [*log.findings, *placing]
    order = placed[rows_topic].order
    rows = _Rows(placed[rows_topic].time[order], placed[rows_topic].segment[order])
    table: dict[str, NDArray[np.float64]] = {}
    for source, hold in _max_ages(columns, system).items():
        topic, path = split_source(source)
        if path in CLOCKS:
            table[source] = rows.time / 1e9
        elif topic == rows_topic:
            table[source] = found[topic].values[path][order]
        else:
            table[source], stale = _hold_newest(source, rows, placed[topic], found[topic].values[path], hold)
            findings += stale
    return Table(table, tuple(findings), rows.segment)


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
            usual = HOLD_ACTION if target in system.action_names else HOLD_STATE
            for source in column.sources:
                holds[source] = usual if column.hold is None else column.hold
    return {**{rule.column: HOLD_ACTION for rule in columns.skip_where}, **holds}


@dataclass(frozen=True)
class _Rows:
    """Times [ns] and segments of the rows, in their order."""

    time: NDArray[np.int64]
    segment: NDArray[np.intp]


def _hold_newest(
    source: str, rows: _Rows, placed: Placed, values: NDArray[np.float64], hold: float
) -> tuple[NDArray[np.float64], list[Finding]]:
    """Latest value of the same segment at each row; NaN if it is older than ``hold`` [s] or if there is none yet."""
    times, segments, values = placed.time[placed.order], placed.segment[placed.order], values[placed.order]
    taken = np.full(len(rows.time), np.nan)
    recent = np.zeros(len(rows.time), dtype=bool)
    for number in np.unique(rows.segment).tolist():
        own = slice(*np.searchsorted(rows.segment, [number, number + 1]))
        begin, end = np.searchsorted(segments, [number, number + 1])
        if begin == end:
            continue
        newest = np.searchsorted(times[begin:end], rows.time[own], side="right") - 1
        known = begin + np.maximum(newest, 0)
        recent[own] = (newest >= 0) & ((rows.time[own] - times[known]) / 1e9 <= hold)
        taken[own] = np.where(recent[own], values[known], np.nan)
    topic = split_source(source)[0]
    old = int((~recent).sum())
    if not old:
        return taken, []
    first = float(rows.time[int(np.flatnonzero(~recent)[0])]) / 1e9
    how = "a row" if old == 1 else f"{old} rows"
    sentence = (
        f"{topic} sent nothing for more than {hold:g} s before {how} of {len(rows.time)}; cut. 'hold' in the map "
        "allows more"
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
