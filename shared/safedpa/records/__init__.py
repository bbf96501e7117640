"""Runs: reading, judging and writing recordings of robots."""

from safedpa.records.column_map.column_map import ColumnMap
from safedpa.records.column_map.file import load_column_map
from safedpa.records.load import load_run
from safedpa.records.readers.mcap import read_messages, read_run_from_mcap
from safedpa.records.run import Finding, Run, Stretch
from safedpa.records.writers.mcap import McapRecorder
from safedpa.records.writers.tables import write_csv, write_parquet

__all__ = [
    "ColumnMap",
    "Finding",
    "McapRecorder",
    "Run",
    "Stretch",
    "load_column_map",
    "load_run",
    "read_messages",
    "read_run_from_mcap",
    "write_csv",
    "write_parquet",
]
