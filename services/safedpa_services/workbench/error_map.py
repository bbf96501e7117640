"""The error over two variables: in which corner of what the robot does the model fails."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safedpa.diagnosis.bins import angle_edges, round_edges
from safedpa.diagnosis.comparison import Comparison
from safedpa.diagnosis.rollout_error import scaled_error, trimmed_rms
from safedpa_services.workbench.brush import Brush, values_of

__all__ = ["ErrorMap", "default_axes", "error_map"]

Floats = NDArray[np.float64]

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
    x_edges: Floats
    y_edges: Floats
    errors: Floats
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


def _edges(comparison: Comparison, name: str, values: Floats) -> Floats:
    angles = {variable.name for variable in comparison.windows.system.state if variable.angle}
    return angle_edges() if name in angles else round_edges(values, most=_MOST_BINS)
