"""Checks of the clock: repeated rows, resets, gaps, irregular sampling; and held (stair-case) columns.

A held column keeps each value over several rows, because its source is slower than the log.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray
from safedpa.records.quality.findings import count_text, finding
from safedpa.records.run import Finding, Stretch
from safedpa.systems import System

if TYPE_CHECKING:
    from safedpa.records.run import RawRows

__all__ = [
    "change_rows",
    "gap_rows",
    "held_findings",
    "hold_rows",
    "rates_finding",
    "reset_rows",
    "sampling_finding",
    "without_repeats",
]

Found = tuple[BoolArray, list[Finding]]

_NEIGHBOURS = 7
"""Steps on either side that define the local median step."""
_BLOCK = 100_000
_RATE_STEPS = 40
"""Steps that a rate must last to count as one."""
_OTHER_RATE = 1.6
"""Ratio of the longest to the shortest lasting step above which the log has two rates."""
_IRREGULAR_SHARE = 0.2
"""Sampling is irregular if one step in ten differs from the median by more than this share of it."""


def without_repeats(rows: RawRows) -> tuple[RawRows, list[Finding]]:
    """Drops rows whose time equals that of the row before in their segment, whatever their values."""
    repeated = np.append(False, np.diff(rows.t) == 0.0)[: len(rows.t)] & ~rows.breaks()
    count = int(repeated.sum())
    if not count:
        return rows, []
    at = np.flatnonzero(repeated)
    same = np.all((rows.states[at] == rows.states[at - 1]) | ~np.isfinite(rows.states[at]), axis=1)
    same &= np.all(rows.actions[at] == rows.actions[at - 1], axis=1)
    others = int((~same).sum())
    text = count_text(count, "row repeats", "rows repeat") + " the time of the row before"
    text += f" ({others} with other values)" if others else ""
    done = "only the first of each time was kept"
    return rows.taken(~repeated), [finding("repeated_row", text, count, rows.t[at[0]], done)]


def reset_rows(rows: RawRows) -> Found:
    """Rows that begin a segment; reported where time goes backwards."""
    mask = rows.breaks()
    back = np.flatnonzero(mask[1:] & (np.diff(rows.t) < 0.0)) + 1
    count = len(back)
    if not count:
        return mask, []
    at = int(back[0])
    text = (
        f"the clock runs backwards {count_text(count, 'time', 'times')} (from {rows.t[at - 1]:.3f} to "
        f"{rows.t[at]:.3f} s)"
    )
    return mask, [finding("clock_reset", text, count, rows.t[at], "cut there")]


def gap_rows(t: NDArray[np.float64]) -> Found:
    """Rows after a gap: a step longer than 1.75 times the median step and beyond its usual spread.

    It is no gap if the neighbouring steps are as long: the log then has another rate there.
    """
    steps = np.diff(t)
    forward = steps[steps > 0.0]
    mask = np.zeros(len(t), dtype=bool)
    if not len(forward):
        return mask, []
    median = float(np.median(forward))
    spread = 1.4826 * float(np.median(np.abs(forward - median)))
    long = np.flatnonzero(steps > max(1.75 * median, median + 8.0 * spread))
    mask[1 + long[steps[long] > 1.75 * _local_median(steps, long)]] = True
    count = int(mask.sum())
    if not count:
        return mask, []
    longest = float(steps[mask[1:]].max())
    text = f"{count_text(count, 'gap', 'gaps')} in time, the longest {longest:.4g} s where {median:.4g} s is usual"
    return mask, [finding("gap", text, count, t[np.flatnonzero(mask)[0] - 1], "cut there")]


def _local_median(steps: NDArray[np.float64], at: NDArray[np.intp]) -> NDArray[np.float64]:
    """Median of each given step and its neighbours on either side; in blocks, to bound the memory."""
    if not len(at):
        return np.empty(0)
    padded = np.pad(steps, _NEIGHBOURS, mode="reflect" if len(steps) > _NEIGHBOURS else "edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEIGHBOURS + 1)
    return np.concatenate([np.median(windows[at[k : k + _BLOCK]], axis=1) for k in range(0, len(at), _BLOCK)])


def rates_finding(t: NDArray[np.float64]) -> list[Finding]:
    """Reports a log that changes to another rate and keeps it for long."""
    steps = np.diff(t[np.isfinite(t)])
    if len(steps) < 2 * _RATE_STEPS:
        return []
    parts = len(steps) // _RATE_STEPS
    usual = np.median(steps[: parts * _RATE_STEPS].reshape(parts, _RATE_STEPS), axis=1)
    usual = np.append(usual, np.median(steps[-_RATE_STEPS:]))
    low, high = float(usual.min()), float(usual.max())
    if not (low > 0.0 and high > _OTHER_RATE * low):
        return []
    middle = np.sqrt(low * high)
    share = float(steps[steps > middle].sum() / steps[steps > 0].sum())
    text = (
        f"two rates in one file: rows are {low:.4g} s apart, and {high:.4g} s for {share:.0%} of the time; both were "
        "used with their true steps; give two files to analyse them separately"
    )
    return [finding("two_rates", text, len(steps))]


def sampling_finding(t: NDArray[np.float64]) -> list[Finding]:
    """Reports steps between rows that vary, apart from gaps."""
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


_MAX_HOLD = 0.25
"""s; an input that is held longer is a manoeuvre, not a slow source."""
_MIN_CHANGES = 20


def change_rows(values: NDArray[np.float64]) -> NDArray[np.intp]:
    """Rows at which the value differs from the row before."""
    return np.flatnonzero(np.diff(values) != 0.0) + 1


def hold_rows(values: NDArray[np.float64]) -> float:
    """Median number of rows for which a column holds its value; 1 for a column that is not held.

    A column is held if it has at least 20 changes, a median hold of 2 rows or more, and more than half of the holds
    within 15 % (or one row) of the median.
    """
    changes = change_rows(values)
    if len(changes) < _MIN_CHANGES:
        return 1.0
    holds = np.diff(changes)
    median = float(np.median(holds))
    near = np.abs(holds - median) <= max(0.15 * median, 1.0 if median >= 5.0 else 0.0)
    return median if median >= 2.0 and float(near.mean()) > 0.5 else 1.0


def held_findings(rows: RawRows, stretches: list[Stretch], system: System, measured: list[bool]) -> list[Finding]:
    """Reports measured states and actions that are held, and for how long."""
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
        if hold > 1.0 and hold * period <= _MAX_HOLD:
            held.setdefault(hold, []).append(name)
    return [_held_finding(names, hold, period, float(rows.t[longest.start])) for hold, names in held.items()]


def _held_finding(names: list[str], hold: float, period: float, start_t: float) -> Finding:
    verb = "is" if len(names) == 1 else "are"
    text = f"{' and '.join(names)} {verb} updated only every {hold:g} rows ({hold * period:.3g} s) and held in between"
    return finding("held", text, len(names), start_t, "nothing was cut for it")
