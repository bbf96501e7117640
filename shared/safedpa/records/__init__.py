"""Runs: reading, judging and writing recordings of robots."""

from safedpa.records.column_map import ColumnMap
from safedpa.records.column_map_file import load_column_map
from safedpa.records.load import load_run
from safedpa.records.mcap_messages import read_messages
from safedpa.records.mcap_recorder import McapRecorder
from safedpa.records.mcap_run import read_run_from_mcap
from safedpa.records.run import Finding, Run, Stretch
from safedpa.records.write import write_csv, write_parquet

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
