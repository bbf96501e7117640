"""From rows to a run: judged, cut, derived, thinned."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from safedpa.errors import RunError
from safedpa.records.apply_map import Rows, derive_states, keep_rows
from safedpa.records.column_map import ColumnMap
from safedpa.records.quality import judged, judged_whole
from safedpa.records.run import Finding, Run, Stretch
from safedpa.systems import System

__all__ = ["run_of_rows"]


def run_of_rows(path: Path, system: System, mapping: ColumnMap, rows: Rows, findings: tuple[Finding, ...]) -> Run:
    """The run that the rows of a file make: judged, cut, derived, thinned; raises RunError when nothing is left."""
    if not len(rows.t):
        raise RunError(f"{path}: no rows" + _listed(findings) + "; wanted at least two")
    rows, stretches, found = judged(rows, mapping, system)
    rows, stretches, derived = derive_states(rows, stretches, mapping, system)
    stretches, whole = judged_whole(rows, stretches, mapping, system, found)
    if mapping.keep_period is not None:
        rows, stretches = keep_rows(rows, stretches, mapping.keep_period)
    rows, stretches = _compact(rows, stretches)
    every = (*findings, *found, *derived, *whole)
    if not stretches:
        raise RunError(f"{path}: no usable stretch of rows" + _listed(every))
    return Run(path.stem, system, rows.t, rows.states, rows.actions, tuple(stretches), every)


def _compact(rows: Rows, stretches: list[Stretch]) -> tuple[Rows, list[Stretch]]:
    """Only the rows within stretches, so that nobody meets the others by accident."""
    lengths = [len(stretch) for stretch in stretches]
    ends = np.cumsum(lengths, dtype=np.intp)
    index = np.concatenate([np.arange(part.start, part.stop) for part in stretches] or [np.empty(0, dtype=np.intp)])
    packed = [Stretch(int(end) - length, int(end)) for end, length in zip(ends, lengths, strict=True)]
    return rows.taken(index), packed


def _listed(findings: tuple[Finding, ...]) -> str:
    return ": " + "; ".join(finding.message for finding in findings) if findings else ""
