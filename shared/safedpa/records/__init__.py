"""Runs: reading, judging and writing recordings of robots."""

from safedpa.records.column_map import ColumnMap
from safedpa.records.column_map_file import load_column_map
from safedpa.records.load import load_run
from safedpa.records.run import Finding, Run, Stretch

__all__ = ["ColumnMap", "Finding", "Run", "Stretch", "load_column_map", "load_run"]
