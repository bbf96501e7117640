"""Stair-case columns: values that are held over several rows because their source is slower than the log."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.records.apply_map import Rows
from safedpa.records.run import Finding, Stretch
from safedpa.records.sentences import finding
from safedpa.systems import System

__all__ = ["change_rows", "held_findings", "hold_rows"]

_LONGEST_HOLD = 0.25
"""s; inputs that are held longer are manoeuvres, not slow sources."""
_FEWEST_CHANGES = 20


def change_rows(values: NDArray[np.float64]) -> NDArray[np.intp]:
    """Rows at which the value differs from the row before."""
    return np.flatnonzero(np.diff(values) != 0.0) + 1


def hold_rows(values: NDArray[np.float64]) -> float:
    """Rows over which a stair-case column usually holds its value; 1 for a column that is none.

    A stair-case: at least 20 changes, median hold of 2 rows or more, more than half of the holds within 15 % (or one
    row) of the median.
    """
    changes = change_rows(values)
    if len(changes) < _FEWEST_CHANGES:
        return 1.0
    holds = np.diff(changes)
    median = float(np.median(holds))
    near = np.abs(holds - median) <= max(0.15 * median, 1.0 if median >= 5.0 else 0.0)
    return median if median >= 2.0 and float(near.mean()) > 0.5 else 1.0


def held_findings(rows: Rows, stretches: list[Stretch], system: System, measured: list[bool]) -> list[Finding]:
    """Which measured states and which actions are held, and for how long."""
    if not stretches:
        return []
    longest = max(stretches, key=len)
    part = slice(longest.start, longest.stop)
    period = float(np.median(np.diff(rows.t[part])))
    columns = [(name, rows.states[part, index]) for index, name in enumerate(system.state_names) if measured[index]]
    columns += [(name, rows.actions[part, index]) for index, name in enumerate(system.action_names)]
    held: dict[float, list[str]] = {}
    for name, values in columns:
        hold = hold_rows(values)
        if hold > 1.0 and hold * period <= _LONGEST_HOLD:
            held.setdefault(hold, []).append(name)
    return [_held(names, hold, period, float(rows.t[longest.start])) for hold, names in held.items()]


def _held(names: list[str], hold: float, period: float, start_t: float) -> Finding:
    verb = "is" if len(names) == 1 else "are"
    text = f"{' and '.join(names)} {verb} updated only every {hold:g} rows ({hold * period:.3g} s) and held between"
    return finding("held", text, len(names), start_t, "nothing was cut for it")
