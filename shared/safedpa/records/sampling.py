"""Defects of the clock: repeated rows, clock resets, gaps, irregular sampling."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.records.apply_map import Rows
from safedpa.records.run import Finding
from safedpa.records.sentences import counted, finding

__all__ = ["gap_rows", "reset_rows", "sampling_finding", "without_repeats"]

Mask = NDArray[np.bool_]
Found = tuple[Mask, list[Finding]]

_IRREGULAR_SHARE = 0.2
"""Sampling is called irregular when one step in ten differs from the median by more than this share of it."""


def without_repeats(rows: Rows) -> tuple[Rows, list[Finding]]:
    """Rows whose time equals that of the row before are dropped, whatever else they hold."""
    repeated = np.append(False, np.diff(rows.t) == 0.0)
    count = int(repeated.sum())
    if not count:
        return rows, []
    at = np.flatnonzero(repeated)
    same = np.all((rows.states[at] == rows.states[at - 1]) | ~np.isfinite(rows.states[at]), axis=1)
    same &= np.all(rows.actions[at] == rows.actions[at - 1], axis=1)
    others = int((~same).sum())
    text = counted(count, "row repeats", "rows repeat") + " the time of the row before"
    text += f" ({others} with other values)" if others else ""
    done = "only the first of each time was kept"
    return rows.taken(~repeated), [finding("repeated_row", text, count, rows.t[at[0]], done)]


def reset_rows(t: NDArray[np.float64]) -> Found:
    """Rows at which time runs backwards."""
    mask = np.append(False, np.diff(t) < 0.0)
    count = int(mask.sum())
    if not count:
        return mask, []
    at = int(np.flatnonzero(mask)[0])
    text = f"the clock runs backwards {counted(count, 'time', 'times')} (from {t[at - 1]:.3f} to {t[at]:.3f} s)"
    return mask, [finding("clock_reset", text, count, t[at], "cut there")]


def gap_rows(t: NDArray[np.float64]) -> Found:
    """Rows behind a gap: a step longer than 1.75 times the median step and beyond its usual spread."""
    steps = np.diff(t)
    forward = steps[steps > 0.0]
    mask = np.zeros(len(t), dtype=bool)
    if not len(forward):
        return mask, []
    median = float(np.median(forward))
    spread = 1.4826 * float(np.median(np.abs(forward - median)))
    mask[1:] = steps > max(1.75 * median, median + 8.0 * spread)
    count = int(mask.sum())
    if not count:
        return mask, []
    longest = float(steps[mask[1:]].max())
    text = f"{counted(count, 'gap', 'gaps')} in time, the longest {longest:.4g} s where {median:.4g} s is usual"
    return mask, [finding("gap", text, count, t[np.flatnonzero(mask)[0] - 1], "cut there")]


def sampling_finding(t: NDArray[np.float64]) -> list[Finding]:
    """Whether the steps between rows vary, gaps aside."""
    steps = np.diff(t)
    steps = steps[steps > 0.0]
    if len(steps) < 10:
        return []
    low, median, high = (float(value) for value in np.quantile(steps, (0.05, 0.5, 0.95)))
    if max(high - median, median - low) <= _IRREGULAR_SHARE * median:
        return []
    text = (
        f"irregular sampling: 9 of 10 steps lie between {low:.4g} and {high:.4g} s, the median is {median:.4g} s; "
        "nothing was cut for it"
    )
    return [finding("irregular_sampling", text, len(steps))]
