"""Readers of logs: each file format becomes a table. Read ``table`` first."""
