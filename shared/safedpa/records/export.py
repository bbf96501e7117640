"""A recording of the bus as one table: states, applied actions and the filter's verdicts, tick by tick."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.errors import RunError
from safedpa.records.mcap_run import Recording, VerdictRow, read_recording
from safedpa.records.run import Finding
from safedpa.records.write import write_columns
from safedpa.systems import System, systems

__all__ = ["Exported", "export_recording"]


@dataclass(frozen=True)
class Exported:
    """What was written."""

    robot: str
    rows: int
    findings: tuple[Finding, ...]


def export_recording(recording: Path, out: Path, kind: str, robot: str | None = None) -> Exported:
    """Writes one robot's ticks as ``csv`` or ``parquet``, whole or not at all.

    Columns: t [s], the states, the actions in force until the next row and, where verdicts were recorded, status,
    slack, h_now, h_next and margin (empty at ticks without one). The last tick, whose action the robot never reported,
    is left out, so are ticks before a lost one. Raises RunError when the recording cannot be used, RecordingError when
    ``out`` cannot be written.
    """
    ticks = read_recording(recording, robot, with_verdicts=True)
    system = _system_of(recording, ticks)
    known = np.flatnonzero(np.isfinite(ticks.actions).all(axis=1))
    if not len(known):
        raise RunError(f"{recording}: robot '{ticks.robot}' has no two ticks in a row; wanted a longer recording")
    columns: dict[str, Any] = {"t": ticks.t[known]}
    columns |= {name: ticks.states[known, index] for index, name in enumerate(system.state_names)}
    columns |= {name: ticks.actions[known, index] for index, name in enumerate(system.action_names)}
    if ticks.verdicts:
        columns |= _verdict_columns([ticks.verdicts.get(ticks.stamps[row]) for row in known])
    write_columns(columns, out, kind)
    return Exported(ticks.robot, len(known), ticks.findings)


def _system_of(path: Path, ticks: Recording) -> System:
    shape = (ticks.states.shape[1], ticks.actions.shape[1])
    for system in systems().values():
        if shape == (len(system.state), len(system.action)):
            return system
    raise RunError(
        f"{path}: robot '{ticks.robot}' has {shape[0]} states and {shape[1]} actions: no known kind of robot"
    )


def _verdict_columns(verdicts: list[VerdictRow | None]) -> dict[str, Any]:
    return {
        name: [None if verdict is None else verdict[place] for verdict in verdicts]
        for place, name in enumerate(("status", "slack", "h_now", "h_next", "margin"))
    }
