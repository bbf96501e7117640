"""Windows by what they measured: their values, boxes drawn around some of them, and what lies inside.

Over two variables the error shows in which corner of what the robot does the model fails.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray
from safedpa.comparison.bins import angle_edges, round_edges
from safedpa.comparison.comparison import Comparison
from safedpa.comparison.rollout_error import scaled_error, trimmed_rms
from safedpa.comparison.where import PLACE
from safedpa.comparison.windows import Windows

__all__ = [
    "ERROR",
    "TIME",
    "Brush",
    "ErrorMap",
    "SelectionSummary",
    "default_axes",
    "error_map",
    "summarize_selection",
    "time_of",
    "values_of",
    "variables_of",
]


_FEWEST = 3
"""Windows that a cell needs."""
_MOST_BINS = 12


@dataclass(frozen=True)
class ErrorMap:
    """Error of the windows in each cell; rows go up, NaN where a cell has too few windows.

    x_edges (columns + 1,), y_edges (rows + 1,); errors and windows (rows, columns).
    """

    x: str
    y: str
    x_edges: FloatArray
    y_edges: FloatArray
    errors: FloatArray
    windows: NDArray[np.int64]

    @property
    def worst(self) -> Brush | None:
        """The cell with the largest error, as a brush."""
        if not np.isfinite(self.errors).any():
            return None
        row, column = np.unravel_index(int(np.nanargmax(self.errors)), self.errors.shape)
        return self._brush(int(row), int(column))

    def cell(self, x: float, y: float) -> Brush:
        """The cell in which a point lies, as a brush."""
        row = int(np.clip(np.searchsorted(self.y_edges, y, side="right") - 1, 0, len(self.y_edges) - 2))
        column = int(np.clip(np.searchsorted(self.x_edges, x, side="right") - 1, 0, len(self.x_edges) - 2))
        return self._brush(row, column)

    def _brush(self, row: int, column: int) -> Brush:
        across = (float(self.x_edges[column]), float(self.x_edges[column + 1]))
        up = (float(self.y_edges[row]), float(self.y_edges[row + 1]))
        return Brush({self.x: across} if self.x == self.y else {self.x: across, self.y: up})


def default_axes(comparison: Comparison) -> tuple[str, str]:
    """The two variables among state and action that explain most of the differences between windows' errors."""
    physical = [item.variable for item in comparison.factors if item.kind in ("state", "action")]
    names = [*physical, *(item.variable for item in comparison.factors if item.kind == "place")]
    return names[0], names[1] if len(names) > 1 else names[0]


def error_map(comparison: Comparison, x: str, y: str) -> ErrorMap:
    """The error in cells of two variables, each window where its value lies."""
    windows, scale = comparison.windows, comparison.error.scale
    across, up = values_of(windows, x), values_of(windows, y)
    x_edges, y_edges = _edges(comparison, x, across), _edges(comparison, y, up)
    columns = np.clip(np.searchsorted(x_edges, across, side="right") - 1, 0, len(x_edges) - 2)
    rows = np.clip(np.searchsorted(y_edges, up, side="right") - 1, 0, len(y_edges) - 2)
    shape = (len(y_edges) - 1, len(x_edges) - 1)
    errors, counts = np.full(shape, np.nan), np.zeros(shape, dtype=np.int64)
    for row, column in {*zip(rows.tolist(), columns.tolist(), strict=True)}:
        inside = (rows == row) & (columns == column)
        counts[row, column] = int(inside.sum())
        if counts[row, column] >= _FEWEST:
            value = scaled_error(trimmed_rms(comparison.errors[inside]), scale).value
            errors[row, column] = value if np.isfinite(value) else np.nan
    return ErrorMap(x, y, x_edges, y_edges, errors, counts)


def _edges(comparison: Comparison, name: str, values: FloatArray) -> FloatArray:
    angles = {variable.name for variable in comparison.windows.system.state if variable.angle}
    return angle_edges() if name in angles else round_edges(values, most=_MOST_BINS)


TIME = "time"
"""Name of the time along all runs, one after another [s]."""
ERROR = "error"
"""Name of a window's own error."""
_PAUSE = 2.0
"""s between two runs on the axis of time."""


@dataclass(frozen=True)
class Brush:
    """Ranges of variables, both ends included; a window is inside where it is inside all of them."""

    ranges: dict[str, tuple[float, float]]

    def mask(self, comparison: Comparison) -> BoolArray:
        """Which windows are inside, shape (windows,)."""
        found = np.ones(len(comparison.windows), dtype=bool)
        for name, (low, high) in self.ranges.items():
            values = _values(comparison, name)
            found &= (values >= min(low, high)) & (values <= max(low, high))
        return found


@dataclass(frozen=True)
class SelectionSummary:
    """What the windows of a selection have in common."""

    windows: int
    of: int
    error: float
    """On the scale of all windows."""
    ratio: float
    """error over that of all."""
    worst_state: str
    bias: float
    """Median of predicted - measured of that state at the horizon, in its unit."""
    unit: str

    @property
    def sentence(self) -> str:
        """The selection in words."""
        if not self.windows:
            return "No window lies in there."
        side = "high" if self.bias > 0 else "low"
        unit = "" if self.unit == "1" else f" {self.unit}"
        return (
            f"{self.windows} of {self.of} windows: error {self.error:.2f}, {self.ratio:.1f} times the average; "
            f"{self.worst_state} in the median {abs(self.bias):.2g}{unit} too {side}."
        )


def variables_of(windows: Windows) -> dict[str, str]:
    """Every variable that a window has a value of, with its unit, states first."""
    return {variable.name: variable.unit for variable in (*windows.system.state, *windows.system.action)}


def values_of(windows: Windows, name: str) -> FloatArray:
    """One variable's value in each window, shape (windows,): its mean; of places and angles that at the middle.

    Angles lie in -pi to pi. As the bins of ``safedpa.comparison.where`` count them.
    """
    system = windows.system
    if name in system.action_names:
        return _mean(windows.actions[:, system.action_names.index(name)], windows.start, windows.end)
    index = system.state_names.index(name)
    middle = windows.states[windows.start + windows.steps // 2, index]
    if system.state[index].angle:
        return np.asarray((middle + np.pi) % (2 * np.pi) - np.pi)
    return middle if name in PLACE else _mean(windows.states[:, index], windows.start, windows.end + 1)


def time_of(windows: Windows) -> FloatArray:
    """When each window begins, s; the runs one after another, with a pause between them."""
    ends = [float(windows.time[windows.end[windows.run == run]].max(initial=0.0)) for run in range(len(windows.names))]
    offsets = np.concatenate([[0.0], np.cumsum(np.array(ends) + _PAUSE)[:-1]])
    return np.asarray(windows.time[windows.start] + offsets[windows.run])


def summarize_selection(comparison: Comparison, mask: BoolArray) -> SelectionSummary:
    """What the selected windows have in common."""
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
        return time_of(comparison.windows)
    return comparison.window_errors if name == ERROR else values_of(comparison.windows, name)


def _mean(column: FloatArray, start: NDArray[np.int64], stop: NDArray[np.int64]) -> FloatArray:
    sums = np.concatenate([[0.0], np.cumsum(column)])
    return np.asarray((sums[stop] - sums[start]) / (stop - start))
