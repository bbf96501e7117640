"""Selects windows by the values of their variables, and computes the error map over two variables.

The error map shows in which region of state and action the model fails.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray
from safedpa.comparison.comparison import Comparison
from safedpa.comparison.rollout_error import scaled_error, trimmed_rms
from safedpa.comparison.where import POSITION, angle_edges, round_edges
from safedpa.comparison.windows import Windows

_MIN_WINDOWS = 3
"""Fewest windows for which a cell shows an error: a trimmed mean of two is one of them."""
_MAX_BINS = 12


@dataclass(frozen=True)
class ErrorMap:
    """Error of the windows in each cell, NaN for a cell with too few windows; rows follow the y axis upwards.

    x_edges (columns + 1,), y_edges (rows + 1,); errors and windows (rows, columns).
    """

    x: str
    y: str
    x_edges: FloatArray
    y_edges: FloatArray
    errors: FloatArray
    windows: NDArray[np.int64]

    @property
    def worst(self) -> Selection | None:
        """Selection of the cell with the largest error; None if no cell has an error."""
        if not np.isfinite(self.errors).any():
            return None
        row, column = np.unravel_index(int(np.nanargmax(self.errors)), self.errors.shape)
        return self._cell_selection(int(row), int(column))

    def cell(self, x: float, y: float) -> Selection:
        """Selection of the cell that contains the point (x, y)."""
        row = int(np.clip(np.searchsorted(self.y_edges, y, side="right") - 1, 0, len(self.y_edges) - 2))
        column = int(np.clip(np.searchsorted(self.x_edges, x, side="right") - 1, 0, len(self.x_edges) - 2))
        return self._cell_selection(row, column)

    def _cell_selection(self, row: int, column: int) -> Selection:
        across = (float(self.x_edges[column]), float(self.x_edges[column + 1]))
        up = (float(self.y_edges[row]), float(self.y_edges[row + 1]))
        return Selection({self.x: across} if self.x == self.y else {self.x: across, self.y: up})


def default_axes(comparison: Comparison) -> tuple[str, str]:
    """The two state or action variables that explain most of the variation of the error between windows."""
    physical = [item.variable for item in comparison.factors if item.kind in ("state", "action")]
    names = [*physical, *(item.variable for item in comparison.factors if item.kind == "position")]
    return names[0], names[1] if len(names) > 1 else names[0]


def error_map(comparison: Comparison, x: str, y: str) -> ErrorMap:
    """Computes the error in each cell of a grid over two variables."""
    windows, scale = comparison.windows, comparison.error.scale
    across, up = window_values(windows, x), window_values(windows, y)
    x_edges, y_edges = _edges(comparison, x, across), _edges(comparison, y, up)
    columns = np.clip(np.searchsorted(x_edges, across, side="right") - 1, 0, len(x_edges) - 2)
    rows = np.clip(np.searchsorted(y_edges, up, side="right") - 1, 0, len(y_edges) - 2)
    shape = (len(y_edges) - 1, len(x_edges) - 1)
    errors, counts = np.full(shape, np.nan), np.zeros(shape, dtype=np.int64)
    for row, column in {*zip(rows.tolist(), columns.tolist(), strict=True)}:
        inside = (rows == row) & (columns == column)
        counts[row, column] = int(inside.sum())
        if counts[row, column] >= _MIN_WINDOWS:
            value = scaled_error(trimmed_rms(comparison.errors[inside]), scale).value
            errors[row, column] = value if np.isfinite(value) else np.nan
    return ErrorMap(x, y, x_edges, y_edges, errors, counts)


def _edges(comparison: Comparison, name: str, values: FloatArray) -> FloatArray:
    angles = {variable.name for variable in comparison.windows.system.state if variable.angle}
    return angle_edges() if name in angles else round_edges(values, most=_MAX_BINS)


TIME = "time"
"""Variable name of the time along all runs, concatenated [s]."""
ERROR = "error"
"""Variable name of the error of a window."""
_PAUSE = 2.0
"""s between two runs on the concatenated time axis."""


@dataclass(frozen=True)
class Selection:
    """Ranges of variables, both ends included; a window is selected if it lies inside all of them."""

    ranges: dict[str, tuple[float, float]]

    def mask(self, comparison: Comparison) -> BoolArray:
        """Which windows are selected, shape (windows,)."""
        found = np.ones(len(comparison.windows), dtype=bool)
        for name, (low, high) in self.ranges.items():
            values = _values(comparison, name)
            found &= (values >= min(low, high)) & (values <= max(low, high))
        return found


@dataclass(frozen=True)
class SelectionSummary:
    """What the windows of a selection have in common."""

    windows: int
    total: int
    error: float
    """Scaled error of the selected windows; the scale is that of all windows."""
    ratio: float
    """Error of the selected windows divided by the error of all windows."""
    worst_state: str
    bias: float
    """Median of predicted - measured of that state at the horizon, in its unit."""
    unit: str

    @property
    def sentence(self) -> str:
        """A sentence that describes the selection."""
        if not self.windows:
            return "The selection contains no window."
        side = "high" if self.bias > 0 else "low"
        unit = "" if self.unit == "1" else f" {self.unit}"
        return (
            f"{self.windows} of {self.total} windows: error {self.error:.2f}, {self.ratio:.1f} times the average; "
            f"{self.worst_state} in the median {abs(self.bias):.2g}{unit} too {side}."
        )


def variable_units(windows: Windows) -> dict[str, str]:
    """Unit of every state and action variable by name, states first."""
    return {variable.name: variable.unit for variable in (*windows.system.state, *windows.system.action)}


def window_values(windows: Windows, name: str) -> FloatArray:
    """Mean of one variable in each window, shape (windows,); for positions and angles the value at mid-window.

    Angles are wrapped to [-pi, pi). The bins of ``safedpa.comparison.where`` use the same values.
    """
    system = windows.system
    if name in system.action_names:
        return _mean(windows.actions[:, system.action_names.index(name)], windows.start, windows.end)
    index = system.state_names.index(name)
    middle = windows.states[windows.start + windows.steps // 2, index]
    if system.state[index].angle:
        return np.asarray((middle + np.pi) % (2 * np.pi) - np.pi)
    return middle if name in POSITION else _mean(windows.states[:, index], windows.start, windows.end + 1)


def window_times(windows: Windows) -> FloatArray:
    """Start time of each window [s] on the concatenated time axis, with a pause between runs."""
    ends = [float(windows.time[windows.end[windows.run == run]].max(initial=0.0)) for run in range(len(windows.names))]
    offsets = np.concatenate([[0.0], np.cumsum(np.array(ends) + _PAUSE)[:-1]])
    return np.asarray(windows.time[windows.start] + offsets[windows.run])


def summarize_selection(comparison: Comparison, mask: BoolArray) -> SelectionSummary:
    """Summarizes the selected windows: their error, and the state with the largest bias."""
    windows, scale = comparison.windows, comparison.error.scale
    chosen = comparison.errors[mask]
    if not len(chosen):
        return SelectionSummary(0, len(windows), float("nan"), float("nan"), "", 0.0, "1")
    error = scaled_error(trimmed_rms(chosen), scale)
    medians = np.median(chosen, axis=0)
    worst = int(np.nanargmax(np.where(scale > 0, np.abs(medians) / np.where(scale > 0, scale, 1.0), np.nan)))
    state = windows.system.state[worst]
    average = comparison.error.value
    ratio = error.value / average if average > 0 else float("nan")
    return SelectionSummary(
        len(chosen), len(windows), error.value, ratio, state.name, float(medians[worst]), state.unit
    )


def _values(comparison: Comparison, name: str) -> FloatArray:
    if name == TIME:
        return window_times(comparison.windows)
    return comparison.window_errors if name == ERROR else window_values(comparison.windows, name)


def _mean(column: FloatArray, start: NDArray[np.int64], stop: NDArray[np.int64]) -> FloatArray:
    sums = np.concatenate([[0.0], np.cumsum(column)])
    return np.asarray((sums[stop] - sums[start]) / (stop - start))
