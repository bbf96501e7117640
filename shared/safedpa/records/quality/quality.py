"""From rows to a run: judged, cut, derived, thinned; what is wrong with a recording is said in sentences.

Cut means: rows with defects end one stretch, the next begins behind them. Nothing is interpolated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray
from safedpa.errors import RunError
from safedpa.limits import readable
from safedpa.records.column_map.apply import Rows, derive_states, resample_rows
from safedpa.records.column_map.column_map import ColumnMap, SourceColumn
from safedpa.records.quality.channels import dead_rows, frozen_rows, jump_rows
from safedpa.records.quality.clock import (
    gap_rows,
    held_findings,
    rates_finding,
    reset_rows,
    sampling_finding,
    without_repeats,
)
from safedpa.records.quality.consistency import consistency_findings, drive_findings, late_findings
from safedpa.records.quality.findings import count_text, finding
from safedpa.records.quality.values import (
    constant_findings,
    degrees_for_radians,
    not_a_number,
    other_units,
    out_of_bounds,
)
from safedpa.records.run import Finding, Run, Stretch
from safedpa.systems import System

__all__ = ["SHORTEST_STRETCH", "run_of_rows"]

SHORTEST_STRETCH = 5
"""Rows; a shorter one says nothing about dynamics."""
_WANTED = f"; wanted {SHORTEST_STRETCH} rows one after another without a defect, or more"


_WRONG = ("swapped_columns", "opposite_sign", "unit_mistake", "yaw_inconsistent", "yaw_offset", "angle_zero")
"""Findings with which columns are not what they seem."""


def _judged(rows: Rows, mapping: ColumnMap, system: System) -> tuple[Rows, list[Stretch], list[Finding]]:
    """Rows without repeats and with angles unwrapped, the stretches between defects, and what was found.

    ``breaks`` below are rows before which a stretch ends; ``bad`` are rows that belong to none.
    """
    measured = [isinstance(mapping.columns[name], SourceColumn) for name in system.state_names]
    rows = Rows(*(np.where(np.isfinite(part), part, np.nan) for part in (rows.t, rows.states, rows.actions)))
    rows, findings = without_repeats(rows)
    bad, found = _bad_values(rows, mapping, system, measured)
    findings += found
    breaks = np.zeros(len(rows.t), dtype=bool)
    for mask, found in (reset_rows(rows.t), gap_rows(rows.t)):
        breaks |= mask
        findings += found
    findings += [*sampling_finding(rows.t), *rates_finding(rows.t)]
    rows = Rows(rows.t, _unwrapped(rows.states, bad, system, mapping), rows.actions)
    stretches = _stretches(bad, breaks)
    mask, found = jump_rows(rows, stretches, system, measured)
    breaks |= mask
    findings += found
    stretches = _long_enough(bad, breaks)
    if stretches:
        mask, found = frozen_rows(rows, stretches, system, measured)
        bad, findings = _cut(bad, findings, "frozen", mask, found, mapping)
        stretches = _long_enough(bad, breaks)
    findings += _message(rows, stretches, system, measured)
    return rows, stretches, [*findings, *_cut_finding(rows.t, stretches)]


def _bad_values(
    rows: Rows, mapping: ColumnMap, system: System, measured: list[bool]
) -> tuple[BoolArray, list[Finding]]:
    """Rows whose numbers cannot be used as they are, and why."""
    bad, findings = not_a_number(rows, system, measured)
    for mask, found in (other_units(rows, system, mapping), degrees_for_radians(rows, system)):
        bad = bad | mask
        findings = [*findings, *found]
    if bad.all():
        return bad, findings
    mask, found = out_of_bounds(rows, system, measured)
    return _cut(bad, findings, "out_of_bounds", mask, found, mapping)


def _cut(
    bad: BoolArray, findings: list[Finding], kind: str, mask: BoolArray, found: list[Finding], mapping: ColumnMap
) -> tuple[BoolArray, list[Finding]]:
    """Bad rows and findings with one more kind, whose rows stay where the map keeps them."""
    if kind not in mapping.keep:
        return bad | mask, [*findings, *found]
    retained = [replace(item, message=f"{item.message.split('; cut out')[0]}; kept, as the map says") for item in found]
    return bad, [*findings, *retained]


def _message(rows: Rows, stretches: list[Stretch], system: System, measured: list[bool]) -> list[Finding]:
    """What nothing is cut for."""
    found = [*held_findings(rows, stretches, system, measured), *constant_findings(rows, stretches, system)]
    disagree = consistency_findings(rows, stretches, system, measured)
    if disagree or not stretches:
        return [*found, *disagree]  # with wrong columns nothing can be said about signs and times
    return [*found, *late_findings(rows, stretches, system, measured)]


def _judged_whole(
    rows: Rows, stretches: list[Stretch], mapping: ColumnMap, system: System, before: Sequence[Finding]
) -> tuple[list[Stretch], list[Finding]]:
    """What needs every state, derived ones as well: commands that are dead, or drive the other way.

    With wrong columns (``before``) nothing can be said about either.
    """
    if not stretches or {item.kind for item in before} & set(_WRONG):
        return stretches, []
    mask, found = dead_rows(rows, stretches, system)
    bad, findings = _cut(np.zeros(len(rows.t), dtype=bool), [], "dead_command", mask, found, mapping)
    if bad.any():
        parts = [_stretches(bad[part.start : part.stop], np.zeros(len(part), dtype=bool)) for part in stretches]
        moved = [
            Stretch(part.start + own.start, part.start + own.stop)
            for part, inner in zip(stretches, parts, strict=True)
            for own in inner
        ]
        stretches = [stretch for stretch in moved if len(stretch) >= SHORTEST_STRETCH]
    return stretches, [*findings, *(drive_findings(rows, stretches, system) if stretches else [])]


def _long_enough(bad: BoolArray, breaks: BoolArray) -> list[Stretch]:
    return [stretch for stretch in _stretches(bad, breaks) if len(stretch) >= SHORTEST_STRETCH]


def _unwrapped(states: NDArray[np.float64], bad: BoolArray, system: System, mapping: ColumnMap) -> NDArray[np.float64]:
    states = states.copy()
    for index in system.angles:
        if mapping.unwrap is None or system.state_names[index] in mapping.unwrap:
            states[~bad, index] = np.unwrap(states[~bad, index])
    return states


def _stretches(bad: BoolArray, breaks: BoolArray) -> list[Stretch]:
    """Maximal ranges without a bad row, ended before each break."""
    good = np.concatenate(([False], ~bad, [False]))
    starts = np.flatnonzero((good[1:-1] & ~good[:-2]) | (good[1:-1] & breaks))
    ends = np.flatnonzero((good[1:-1] & ~good[2:]) | (good[1:-1] & np.append(breaks[1:], True)))
    return [Stretch(int(start), int(end) + 1) for start, end in zip(starts, ends, strict=True)]


def _cut_finding(t: NDArray[np.float64], stretches: list[Stretch]) -> list[Finding]:
    retained = np.zeros(len(t), dtype=bool)
    for stretch in stretches:
        retained[stretch.start : stretch.stop] = True
    if retained.all():
        return []
    cut = np.flatnonzero(~retained)
    share = 100.0 * len(cut) / len(t)
    remain = count_text(len(stretches), "stretch remains", "stretches remain")
    text = f"{len(cut)} of {len(t)} rows ({share:.3g} %) were cut in all; {remain}"
    return [finding("cut", text, len(cut), t[cut[0]])]


def run_of_rows(path: Path, system: System, mapping: ColumnMap, rows: Rows, findings: tuple[Finding, ...]) -> Run:
    """The run that the rows of a file make: judged, cut, derived, thinned; raises RunError when nothing is left."""
    if not len(rows.t):
        raise RunError(f"{path}: no rows" + _listed(findings) + _WANTED)
    rows, stretches, found = _judged(rows, mapping, system)
    rows, stretches, derived = derive_states(rows, stretches, mapping, system)
    stretches, whole = _judged_whole(rows, stretches, mapping, system, found)
    if mapping.keep_period is not None:
        rows, stretches = resample_rows(rows, stretches, mapping.keep_period)
    rows, stretches = _compact(rows, stretches)
    every = (*findings, *found, *derived, *whole)
    if not stretches:
        raise RunError(f"{path}: no usable stretch of rows" + _listed(every) + _WANTED)
    return Run(readable(path.stem), system, rows.t, rows.states, rows.actions, tuple(stretches), every)


def _compact(rows: Rows, stretches: list[Stretch]) -> tuple[Rows, list[Stretch]]:
    """Only the rows within stretches, so that no one meets the others by accident."""
    lengths = [len(stretch) for stretch in stretches]
    ends = np.cumsum(lengths, dtype=np.intp)
    index = np.concatenate([np.arange(part.start, part.stop) for part in stretches] or [np.empty(0, dtype=np.intp)])
    packed = [Stretch(int(end) - length, int(end)) for end, length in zip(ends, lengths, strict=True)]
    return rows.taken(index), packed


def _listed(findings: tuple[Finding, ...]) -> str:
    return ": " + "; ".join(finding.message for finding in findings) if findings else ""
