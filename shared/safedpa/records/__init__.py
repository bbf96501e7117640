"""Reads, checks and writes recordings of robots.

Read ``run`` first (a recording in memory), then ``load``, which loads a file of any format. ``readers`` read the file
formats, ``segments`` cuts times where a clock was set, ``column_map`` converts foreign columns to states and actions,
``quality`` finds and cuts defective rows, and ``writers`` write files. ``earlier_format`` converts files of format 1.
"""

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
