"""Defects of a log: clocks, values, channels, consistency. Read ``quality`` first."""
