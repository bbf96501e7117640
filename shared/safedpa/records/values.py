"""Defects of single values: not a number, beyond plausible bounds, inputs that never change."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.records.apply_map import Rows
from safedpa.records.run import Finding, Stretch
from safedpa.records.sentences import counted, finding
from safedpa.systems import System, Variable

__all__ = ["constant_findings", "not_a_number", "out_of_bounds"]

Found = tuple[NDArray[np.bool_], list[Finding]]


def _columns(rows: Rows, system: System, measured: list[bool]) -> list[tuple[Variable, NDArray[np.float64]]]:
    """Every measured column with its variable; derived ones are not judged, they follow from others."""
    states = [(variable, rows.states[:, index]) for index, variable in enumerate(system.state) if measured[index]]
    return states + [(variable, rows.actions[:, index]) for index, variable in enumerate(system.action)]


def not_a_number(rows: Rows, system: System, measured: list[bool]) -> Found:
    """Rows in which time, a measured state or an action is missing, NaN or infinite."""
    columns = [("t", rows.t), *((variable.name, values) for variable, values in _columns(rows, system, measured))]
    masks = {name: ~np.isfinite(values) for name, values in columns}
    bad = np.any(list(masks.values()), axis=0)
    count = int(bad.sum())
    if not count:
        return bad, []
    names = ", ".join(name for name, mask in masks.items() if mask.any())
    text = f"{counted(count, 'row', 'rows')} without a finite number in {names}"
    return bad, [finding("not_a_number", text, count, _time_at(rows.t, int(np.argmax(bad))), "cut out")]


def _time_at(t: NDArray[np.float64], row: int) -> float | None:
    """Time of a row, or of the last one before it that has a time."""
    before = t[: row + 1][np.isfinite(t[: row + 1])]
    return float(before[-1]) if len(before) else None


def out_of_bounds(rows: Rows, system: System, measured: list[bool]) -> Found:
    """Rows with a measured state or an action outside the range that its system declares."""
    bad = np.zeros(len(rows.t), dtype=bool)
    found = []
    for variable, values in _columns(rows, system, measured):
        slack = 1e-6 * max(abs(variable.low), abs(variable.high)) if np.isfinite(variable.high) else 0.0
        mask = np.isfinite(values) & ((values < variable.low - slack) | (values > variable.high + slack))
        count = int(mask.sum())
        if count:
            worst = float(values[mask][np.argmax(np.abs(values[mask]))])
            text = (
                f"{counted(count, 'row', 'rows')} with {variable.name} outside {variable.low:g} .. {variable.high:g} "
                f"{variable.unit}, the worst {worst:.4g}"
            )
            done = (
                "cut out; if the robot does that, widen the bound in its system, or say "
                'keep = ["out_of_bounds"] in a column map; else name the unit or scale there'
            )
            found.append(finding("out_of_bounds", text, count, _time_at(rows.t, int(np.argmax(mask))), done))
            bad |= mask
    return bad, found


def constant_findings(rows: Rows, stretches: list[Stretch], system: System) -> list[Finding]:
    """Actions that never change, and runs in which nothing moves."""
    if not stretches:
        return []
    kept = np.concatenate([np.arange(stretch.start, stretch.stop) for stretch in stretches])
    found = []
    for index, variable in enumerate(system.action):
        values = rows.actions[kept, index]
        if np.ptp(values) <= 1e-9 * max(1.0, float(np.abs(values).max())):
            text = (
                f"{variable.name} is always {values[0]:.4g} {variable.unit}: "
                "the run cannot show what it does; nothing was cut for it"
            )
            found.append(finding("constant_input", text, len(kept)))
    if np.nanmax(np.ptp(rows.states[kept], axis=0), initial=0.0) <= 1e-9:
        found.append(finding("no_motion", "no state ever changes: the run says nothing about dynamics", len(kept)))
    return found
