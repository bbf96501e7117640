"""Benchmarks: every absolute time beside a reference that was measured in the same run."""
