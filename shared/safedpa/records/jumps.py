"""Jumps: states that change from one row to the next by more than their own motion explains."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.records.apply_map import Rows
from safedpa.records.held import change_rows, hold_rows
from safedpa.records.run import Finding, Stretch
from safedpa.records.sentences import counted, finding
from safedpa.systems import System

__all__ = ["jump_rows"]

_SMALLEST_JUMP = {"m": 0.1, "rad": 0.3, "m/s": 1.5, "rad/s": 5.0}
"""Smaller steps are never called jumps: they are noise, or a harmless part of the motion."""
_NEIGHBOURS = 5
_TIMES_MEDIAN = 4.0
_BLOCK = 100_000


def jump_rows(
    rows: Rows, stretches: list[Stretch], system: System, measured: list[bool]
) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Rows behind a jump of a measured state.

    A step |x[k+1] - x[k]| is a jump when it exceeds a floor plus 4 times the median rate of the five steps on either
    side, times its own duration: the change is then not explained by the speed around it. A held column is judged at
    the rows where it changes.
    """
    mask = np.zeros(len(rows.t), dtype=bool)
    found = []
    for index, variable in enumerate(system.state):
        floor = _SMALLEST_JUMP.get(variable.unit)
        if floor is None or not measured[index]:
            continue
        at, largest = _jumps(rows.t, rows.states[:, index], stretches, floor)
        if len(at):
            mask[at] = True
            text = f"{variable.name} jumps {counted(len(at), 'time', 'times')} by up to {largest:.4g} {variable.unit}"
            text += ", more than the motion around explains"
            found.append(finding("jump", text, len(at), rows.t[at[0]], "cut there"))
    return mask, found


def _jumps(
    t: NDArray[np.float64], values: NDArray[np.float64], stretches: list[Stretch], floor: float
) -> tuple[NDArray[np.intp], float]:
    found, largest = [], 0.0
    for stretch in stretches:
        part = values[stretch.start : stretch.stop]
        at = np.arange(len(part))
        if hold_rows(part) > 1.0:
            at = np.append(0, change_rows(part))
        steps = np.abs(np.diff(part[at]))
        large = np.flatnonzero(steps > floor)
        times = np.diff(t[stretch.start : stretch.stop][at])
        usual = _TIMES_MEDIAN * _usual_rate(steps / times, large) * times[large]
        jumps = large[steps[large] > floor + usual]
        found.append(at[jumps + 1] + stretch.start)
        largest = max(largest, float(steps[jumps].max(initial=0.0)))
    return np.concatenate(found) if found else np.empty(0, dtype=np.intp), largest


def _usual_rate(rates: NDArray[np.float64], rows: NDArray[np.intp]) -> NDArray[np.float64]:
    """Median of each rate and its neighbours on either side, at some rows, in blocks to bound the memory."""
    if not len(rows):
        return np.empty(0)
    padded = np.pad(rates, _NEIGHBOURS, mode="reflect" if len(rates) > _NEIGHBOURS else "edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEIGHBOURS + 1)
    return np.concatenate([np.median(windows[rows[k : k + _BLOCK]], axis=1) for k in range(0, len(rows), _BLOCK)])
