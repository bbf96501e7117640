"""What is wrong with a recording: found, cut where needed, and said in sentences.

Cut means: rows with defects end one stretch, the next begins behind them. Nothing is interpolated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.records.apply_map import Rows
from safedpa.records.column_map import ColumnMap, SourceColumn
from safedpa.records.consistency import consistency_findings
from safedpa.records.degrees import degrees_for_radians
from safedpa.records.held import held_findings
from safedpa.records.jumps import jump_rows
from safedpa.records.run import Finding, Stretch
from safedpa.records.sampling import gap_rows, reset_rows, sampling_finding, without_repeats
from safedpa.records.sentences import counted, finding
from safedpa.records.values import constant_findings, not_a_number, out_of_bounds
from safedpa.systems import System

__all__ = ["SHORTEST_STRETCH", "judged"]

SHORTEST_STRETCH = 5
"""Rows; a shorter one says nothing about dynamics."""

Mask = NDArray[np.bool_]


def judged(rows: Rows, mapping: ColumnMap, system: System) -> tuple[Rows, list[Stretch], list[Finding]]:
    """Rows without repeats and with angles unwrapped, the stretches between defects, and what was found.

    ``breaks`` below are rows before which a stretch ends; ``bad`` are rows that belong to none.
    """
    measured = [isinstance(mapping.columns[name], SourceColumn) for name in system.state_names]
    rows = Rows(*(np.where(np.isfinite(part), part, np.nan) for part in (rows.t, rows.states, rows.actions)))
    rows, findings = without_repeats(rows)
    bad = np.zeros(len(rows.t), dtype=bool)
    for mask, found in (
        not_a_number(rows, system, measured),
        degrees_for_radians(rows, system),
        out_of_bounds(rows, system, measured),
    ):
        bad |= mask
        findings += found
    breaks = np.zeros(len(rows.t), dtype=bool)
    for mask, found in (reset_rows(rows.t), gap_rows(rows.t)):
        breaks |= mask
        findings += found
    findings += sampling_finding(rows.t)
    rows = Rows(rows.t, _unwrapped(rows.states, bad, system, mapping), rows.actions)
    stretches = _stretches(bad, breaks)
    mask, found = jump_rows(rows, stretches, system, measured)
    breaks |= mask
    findings += found
    every = _stretches(bad, breaks)
    stretches = [stretch for stretch in every if len(stretch) >= SHORTEST_STRETCH]
    findings += held_findings(rows, stretches, system, measured)
    findings += constant_findings(rows, stretches, system)
    findings += consistency_findings(rows, stretches, system, measured)
    return rows, stretches, [*findings, *_cut_finding(rows.t, stretches)]


def _unwrapped(states: NDArray[np.float64], bad: Mask, system: System, mapping: ColumnMap) -> NDArray[np.float64]:
    states = states.copy()
    for index in system.angles:
        if mapping.unwrap is None or system.state_names[index] in mapping.unwrap:
            states[~bad, index] = np.unwrap(states[~bad, index])
    return states


def _stretches(bad: Mask, breaks: Mask) -> list[Stretch]:
    """Maximal ranges without a bad row, ended before each break."""
    good = np.concatenate(([False], ~bad, [False]))
    starts = np.flatnonzero((good[1:-1] & ~good[:-2]) | (good[1:-1] & breaks))
    ends = np.flatnonzero((good[1:-1] & ~good[2:]) | (good[1:-1] & np.append(breaks[1:], True)))
    return [Stretch(int(start), int(end) + 1) for start, end in zip(starts, ends, strict=True)]


def _cut_finding(t: NDArray[np.float64], stretches: list[Stretch]) -> list[Finding]:
    kept = np.zeros(len(t), dtype=bool)
    for stretch in stretches:
        kept[stretch.start : stretch.stop] = True
    if kept.all():
        return []
    cut = np.flatnonzero(~kept)
    share = 100.0 * len(cut) / len(t)
    remain = counted(len(stretches), "stretch remains", "stretches remain")
    text = f"{len(cut)} of {len(t)} rows ({share:.3g} %) were cut in all; {remain}"
    return [finding("cut", text, len(cut), t[cut[0]])]
