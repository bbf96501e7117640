"""Diagnosis of hours of logs: seconds and memory, and how both grow."""

from __future__ import annotations

import json
from typing import Any

from safedpa_lab.benchmarks.results import Curve, Effort, Entry, Row, Target
from safedpa_lab.benchmarks.usage import output_of

_PERIOD = 0.01
_MOST_SECONDS = 60.0
"""By the clock, of ten hours."""


def measure(effort: Effort) -> Row:
    """``safedpa experiment long-logs`` for several lengths, ten runs each."""
    runs = effort.of(2, 10)
    lengths = effort.of((20.0, 40.0), (36.0, 360.0, 3600.0))
    found = {runs * seconds / 3600.0: _diagnosed(runs, seconds) for seconds in lengths}
    ours = tuple(_entry(hours, row) for hours, row in found.items())
    hours, last = list(found.items())[-1]
    before, shorter = list(found.items())[-2]
    growth = (last["seconds"] / shorter["seconds"]) / (hours / before)
    targets = [
        Target(f"memory, {hours:.3g} h", 2048.0, float(last["memory_mebibytes"]), "MiB"),
        Target(f"growth of time over growth of data, {before:.3g} to {hours:.3g} h", 1.0, growth, ""),
    ]
    if not effort.quick:
        targets.insert(0, Target(f"seconds, {hours:.3g} h", _MOST_SECONDS, float(last["seconds"]), "s"))
    series: dict[str, tuple[float | None, ...]] = {"seconds": tuple(float(row["seconds"]) for row in found.values())}
    series["memory [MiB]"] = tuple(float(row["memory_mebibytes"]) for row in found.values())
    curve = Curve("long_logs", "hours of logs at 100 Hz", "seconds; MiB", tuple(found), series)
    work = f"diagnosis of {hours:.3g} h of logs at 100 Hz, from files to report"
    return Row("long-logs", work, "seconds", ours, targets=tuple(targets), curves=(curve,))


def _entry(hours: float, row: dict[str, Any]) -> Entry:
    figures = {"seconds": float(row["seconds"]), "mib": float(row["memory_mebibytes"])}
    processor = {"seconds": float(row["processor_seconds"])}
    found = ", ".join(row["added"] or ()) or "nothing"
    return Entry(f"safedpa, {hours:.3g} h", figures, "s", processor, f"{hours:.3g} h", f"found {found}; drag is hidden")


def _diagnosed(runs: int, seconds: float) -> dict[str, Any]:
    length = ("--runs", str(runs), "--seconds", repr(seconds), "--period", repr(_PERIOD))
    rows = json.loads(output_of("experiment", "long-logs", "--json", *length))["rows"]
    return next(dict(row) for row in rows if row["command"] == "diagnose")
