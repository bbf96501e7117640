"""Checks a whole recording by its reader."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from safedpa.errors import SafedpaError
from safedpa.records import ColumnMap, load_run
from safedpa.systems import System


@dataclass(frozen=True)
class RecordingCheck:
    """Result of reading a recording: first rows in SI units and quality findings, or the problem."""

    problem: str
    sentence: str
    names: tuple[str, ...]
    rows: tuple[tuple[float, ...], ...]
    findings: tuple[str, ...]


def check_recording(path: str | Path, system: System, columns: ColumnMap | None, count: int = 5) -> RecordingCheck:
    """Reads a recording as the diagnosis would; an error is returned in ``problem``, not raised."""
    names = ("t", *system.state_names, *system.action_names)
    try:
        run = load_run(path, system, columns)
    except SafedpaError as error:
        return RecordingCheck(str(error), "", names, (), ())
    rows = tuple(
        (float(run.t[row] - run.t[0]), *map(float, run.states[row]), *map(float, run.actions[row]))
        for row in range(min(count, len(run.t)))
    )
    row_count = sum(len(part) for part in run.stretches)
    stretches = "1 stretch" if len(run.stretches) == 1 else f"{len(run.stretches)} stretches"
    sentence = f"{row_count} rows in {stretches}, {run.duration:.1f} s, one every {run.period:.4g} s"
    return RecordingCheck("", sentence, names, rows, tuple(_messages(run.findings)))


def _messages(findings: Sequence[object]) -> list[str]:
    return list(dict.fromkeys(str(getattr(item, "message", item)) for item in findings))
