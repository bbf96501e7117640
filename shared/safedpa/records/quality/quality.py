"""Turns the rows of a file into a run: checks and cuts them, derives missing states and resamples.

A defective row ends a stretch, and the next stretch begins after it. Nothing is interpolated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray
from safedpa.errors import RunError
from safedpa.limits import readable
from safedpa.records.column_map.apply import derive_states, resample_rows
from safedpa.records.column_map.column_map import ColumnMap, SourceColumn
from safedpa.records.quality.channels import dead_rows, frozen_rows, jump_rows, quantised_findings, spike_rows
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
from safedpa.records.quality.halves import halves_findings
from safedpa.records.quality.values import (
    constant_findings,
    degrees_for_radians,
    not_a_number,
    other_units,
    out_of_bounds,
)
from safedpa.records.readers.table import plausible_numbers
from safedpa.records.run import Finding, RawRows, Run, Stretch
from safedpa.systems import System

__all__ = ["SHORTEST_STRETCH", "run_of_rows"]

SHORTEST_STRETCH = 5
"""Rows; a shorter stretch has no information about the dynamics."""
_REQUIREMENT = f"; wanted at least {SHORTEST_STRETCH} consecutive rows without a defect"


_WRONG_COLUMNS = ("swapped_columns", "opposite_sign", "unit_mistake", "yaw_inconsistent", "yaw_offset", "angle_zero")
"""Findings that say that some column is not what the map claims."""


def _check_rows(rows: RawRows, mapping: ColumnMap, system: System) -> tuple[RawRows, list[Stretch], list[Finding]]:
    """Returns rows without repeats and with unwrapped angles, the stretches between defects, and the findings.

    Below, a stretch ends before each row in ``breaks``; rows in ``bad`` belong to no stretch.
    """
    measured = [isinstance(mapping.columns[name], SourceColumn) for name in system.state_names]
    t, states, actions = (plausible_numbers(part) for part in (rows.t, rows.states, rows.actions))
    rows = RawRows(t, states, actions, rows.segment)
    rows, findings = without_repeats(rows)
    bad, found = _bad_values(rows, mapping, system, measured)
    findings += found
    breaks = np.zeros(len(rows.t), dtype=bool)
    for mask, found in (reset_rows(rows), gap_rows(rows.t)):
        breaks |= mask
        findings += found
    findings += [*sampling_finding(rows.t), *rates_finding(rows.t)]
    rows = replace(rows, states=_unwrap(rows.states, bad, system, mapping))
    mask, found = spike_rows(rows, bad, system, measured)
    bad, findings = _cut(bad, findings, "jump", mask, found, mapping)
    stretches = _stretches(bad, breaks)
    mask, found = jump_rows(rows, stretches, system, measured)
    breaks |= mask
    findings += found
    stretches = _usable_stretches(bad, breaks)
    if stretches:
        mask, found = frozen_rows(rows, stretches, system, measured)
        bad, findings = _cut(bad, findings, "frozen", mask, found, mapping)
        stretches = _usable_stretches(bad, breaks)
    findings += _other_findings(rows, stretches, system, measured)
    return rows, stretches, [*findings, *_cut_finding(rows.t, stretches)]


def _bad_values(
    rows: RawRows, mapping: ColumnMap, system: System, measured: list[bool]
) -> tuple[BoolArray, list[Finding]]:
    """Rows with unusable values, and the findings."""
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
    """Adds findings of one kind; their rows become bad unless the map keeps this kind."""
    if kind not in mapping.keep:
        return bad | mask, [*findings, *found]
    kept = [replace(item, message=f"{item.message.split('; cut out')[0]}; kept, as the map says") for item in found]
    return bad, [*findings, *kept]


def _other_findings(rows: RawRows, stretches: list[Stretch], system: System, measured: list[bool]) -> list[Finding]:
    """Findings for which nothing is cut."""
    found = [*held_findings(rows, stretches, system, measured), *constant_findings(rows, stretches, system)]
    found += quantised_findings(rows, stretches, system, measured)
    disagree = consistency_findings(rows, stretches, system, measured)
    if disagree or not stretches:
        return [*found, *disagree]  # with wrong columns signs and delays cannot be checked
    return [*found, *late_findings(rows, stretches, system, measured)]


def _check_commands(
    rows: RawRows, stretches: list[Stretch], mapping: ColumnMap, system: System, before: Sequence[Finding]
) -> tuple[list[Stretch], list[Finding]]:
    """Checks that need all states, also derived ones: dead commands, and commands of the opposite sign.

    They are skipped if an earlier finding in ``before`` says that a column is wrong.
    """
    if not stretches or {item.kind for item in before} & set(_WRONG_COLUMNS):
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
    findings += drive_findings(rows, stretches, system) if stretches else []
    if not stretches or findings:
        return stretches, findings
    halves = [item.accepted_in(mapping.keep) for item in halves_findings(rows, stretches, system)]
    return _cut_at(rows.t, stretches, [item for item in halves if item.kind == "jump"]), halves


def _cut_at(t: NDArray[np.float64], stretches: list[Stretch], jumps: Sequence[Finding]) -> list[Stretch]:
    """The stretches, with an end before the time of each finding."""
    breaks = np.zeros(len(t), dtype=bool)
    for item in jumps:
        breaks |= t == item.start_t
    parts = []
    for part in stretches:
        inner = np.flatnonzero(breaks[part.start + 1 : part.stop]) + part.start + 1
        parts += [Stretch(low, high) for low, high in pairwise([part.start, *inner.tolist(), part.stop])]
    return [part for part in parts if len(part) >= SHORTEST_STRETCH]


def _usable_stretches(bad: BoolArray, breaks: BoolArray) -> list[Stretch]:
    return [stretch for stretch in _stretches(bad, breaks) if len(stretch) >= SHORTEST_STRETCH]


def _unwrap(states: NDArray[np.float64], bad: BoolArray, system: System, mapping: ColumnMap) -> NDArray[np.float64]:
    states = states.copy()
    for index in system.angles:
        if mapping.unwrap is None or system.state_names[index] in mapping.unwrap:
            states[~bad, index] = np.unwrap(states[~bad, index])
    return states


def _stretches(bad: BoolArray, breaks: BoolArray) -> list[Stretch]:
    """Maximal ranges of rows without a bad row or a break inside."""
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
    remain = count_text(len(stretches), "stretch remains", "stretches remain")
    text = f"{len(cut)} of {len(t)} rows ({share:.3g} %) were cut in all; {remain}"
    return [finding("cut", text, len(cut), t[cut[0]])]


def run_of_rows(path: Path, system: System, mapping: ColumnMap, rows: RawRows, findings: tuple[Finding, ...]) -> Run:
    """Turns the rows of a file into a run; raises RunError if no usable stretch is left."""
    if not len(rows.t):
        raise RunError(f"{path}: no rows" + _listed(findings) + _REQUIREMENT)
    rows, stretches, found = _check_rows(rows, mapping, system)
    rows, stretches, derived = derive_states(rows, stretches, mapping, system)
    stretches, whole = _check_commands(rows, stretches, mapping, system, found)
    if mapping.keep_period is not None:
        rows, stretches = resample_rows(rows, stretches, mapping.keep_period)
    rows, stretches = _compact(rows, stretches)
    every = (*findings, *found, *derived, *whole)
    if not stretches:
        raise RunError(f"{path}: no usable stretch of rows" + _listed(every) + _REQUIREMENT)
    return Run(readable(path.stem), system, rows.t, rows.states, rows.actions, tuple(stretches), every, mapping.keep)


def _compact(rows: RawRows, stretches: list[Stretch]) -> tuple[RawRows, list[Stretch]]:
    """Removes the rows outside the stretches, so that they cannot be used by accident."""
    lengths = [len(stretch) for stretch in stretches]
    ends = np.cumsum(lengths, dtype=np.intp)
    index = np.concatenate([np.arange(part.start, part.stop) for part in stretches] or [np.empty(0, dtype=np.intp)])
    packed = [Stretch(int(end) - length, int(end)) for end, length in zip(ends, lengths, strict=True)]
    return rows.taken(index), packed


def _listed(findings: tuple[Finding, ...]) -> str:
    return ": " + "; ".join(finding.message for finding in findings) if findings else ""
