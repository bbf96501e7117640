"""Loads a recording of any format as a run in SI units, without its defective rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from safedpa.errors import ColumnMapError, InputError, RunError, escaped
from safedpa.records.column_map.apply import check_map, mapped_rows
from safedpa.records.column_map.column_map import ColumnMap, native_map
from safedpa.records.quality.quality import run_of_rows
from safedpa.records.readers.bags import check_readable_mcap, kind_of, read_log_table, topic_log
from safedpa.records.readers.own_process import in_own_process
from safedpa.records.readers.table import Table, regular_file
from safedpa.records.run import Finding, RawRows, Run
from safedpa.systems import System

__all__ = ["load_run", "read_columns"]

_MAX_TOPICS = 8
"""Topics that an error lists; the command ``safedpa columns`` lists all."""


def load_run(path: str | Path, system: System, columns: ColumnMap | None = None) -> Run:
    """Loads a table, bag, flight log or bus recording as a run; the first bytes decide which one it is.

    Without a column map the columns must have the native names: ``t`` [s] and those of the system's states and actions.
    A log of topics needs a map. ``-`` is standard input; that and a named pipe are first copied to a temporary file.
    Time is that of the file. Raises RunError if the file cannot be used (with all findings
    if no stretch of it can), and ColumnMapError if the map does not fit the system.
    """
    mapping = native_map(system) if columns is None else columns
    check_map(mapping, system)
    with regular_file(Path(path)) as file:
        try:
            rows, findings = _rows_of(file, system, columns, mapping)
            return run_of_rows(file, system, mapping, rows, findings)
        except InputError as error:
            if file == Path(path):
                raise
            raise type(error)(str(error).replace(escaped(str(file)), str(path))) from error
        except OSError as error:
            reason = error.strerror or str(error)
            raise RunError(f"{path}: cannot be read ({reason}); check the file and its permissions") from error


@in_own_process
def _rows_of(
    path: Path, system: System, columns: ColumnMap | None, mapping: ColumnMap
) -> tuple[RawRows, tuple[Finding, ...]]:
    kind = kind_of(path)
    if kind == "mcap":
        if columns is not None:
            check_readable_mcap(path)
            raise ColumnMapError(f"{columns.name}: {path} is a recording of the bus; leave the column map out")
        from safedpa.records.readers.mcap import read_rows_from_mcap

        return read_rows_from_mcap(path, system)
    if kind == "topics" and columns is None:
        raise RunError(_map_needed(path, system))
    if kind == "topics":
        return mapped_rows(read_log_table(topic_log(path), mapping, system), mapping, system)
    return mapped_rows(_read(path, kind, mapping.sources), mapping, system)


@in_own_process
def read_columns(path: Path, sources: Sequence[str]) -> Table:
    """Reads columns of a table as they are. Raises RunError for an unusable file, InputError for a log of topics."""
    kind = kind_of(path)
    if kind in ("topics", "mcap"):
        raise InputError(f"{path}: got a log of topics, wanted a table; 'safedpa columns {path}' lists its contents")
    return _read(path, kind, sources)


def _map_needed(path: Path, system: System) -> str:
    """Error message for a log of topics without a map: its topics, and how to propose a map."""
    log = topic_log(path)
    topics = [topic for topic in log.topics().values() if topic.count]
    if topics and all(topic.name.startswith("safedpa/") for topic in topics):
        return f"{path}: is the folder of a run; name the recording in it: {path / 'recording.mcap'}"
    notice = "; ".join(f"{topic.name} ({topic.type}, {topic.rate:.0f} Hz)" for topic in topics[:_MAX_TOPICS])
    more = f" and {len(topics) - _MAX_TOPICS} more" if len(topics) > _MAX_TOPICS else ""
    return (
        f"{path}: is a {log.kind} with {len(topics)} topics, and needs a column map: {notice}{more}; "
        f"'safedpa columns {path} --robot {system.name} > map.toml' proposes one, then --columns map.toml"
    )


def _read(path: Path, kind: str, sources: Sequence[str]) -> Table:
    if kind == "arrays":
        from safedpa.records.readers.arrays import read_array_table

        return read_array_table(path, sources)
    if kind == "dataset":
        from safedpa.records.readers.parquet import read_dataset

        return read_dataset(path, sources)
    if kind == "parquet":
        from safedpa.records.readers.parquet import read_parquet_table

        return read_parquet_table(path, sources)
    from safedpa.records.readers.csv import read_csv_table

    return read_csv_table(path, sources)
