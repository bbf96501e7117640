"""Margins from measurements: runs, drives and recordings. Read ``from_runs`` first."""
