"""Benchmarks: every absolute time next to a reference that was measured in the same run."""
