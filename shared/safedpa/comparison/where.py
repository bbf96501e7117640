"""Where a model fails: its error in bins of speed, action, heading, position and time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.comparison.rollout_error import TRIM, scaled_error, trimmed_rms
from safedpa.comparison.windows import Windows

POSITION = ("x", "y")
"""Names of the states that are the position of the robot."""


@dataclass(frozen=True)
class Bin:
    """The windows in which one variable lies between low and high (time: of one run)."""

    variable: str
    unit: str
    low: float
    high: float
    error: float
    """Rollout error over these windows, on the scale of all windows."""
    ratio: float
    """error over the error of all windows."""
    share: float
    """Share of the total squared error."""
    samples: int
    """Number of windows."""
    bias: dict[str, float]
    """Median of predicted - measured at the horizon, by state."""
    run: str | None = None


@dataclass(frozen=True)
class Factor:
    """One variable, its bins, and how much of the variation of the windows' errors it explains.

    explained = 1 - (n - 1) / (n - bins) * (variance within bins) / (variance of all): the adjusted R2 of the bins.
    """

    variable: str
    unit: str
    kind: str
    """state, action, position or time"""
    explained: float
    bins: tuple[Bin, ...]


@dataclass(frozen=True)
class Cell:
    """The windows whose middle lies in one rectangle of the plane [m]."""

    x_low: float
    x_high: float
    y_low: float
    y_high: float
    error: float
    share: float
    samples: int


def window_squares(errors: FloatArray, scale: FloatArray) -> FloatArray:
    """Returns the squared scaled error of each window, mean over the states, (windows,).

    Squares of each state are capped at their 95 % quantile, so that one glitch does not hide the rest.
    """
    moved = scale > 0
    if not moved.any():
        return np.zeros(len(errors))
    finite = np.where(np.isfinite(errors) & (np.abs(errors) < 1e100), errors, np.nan)[:, moved] / scale[moved]
    squares = np.where(np.isnan(finite), np.nanmax(finite**2, initial=1.0), finite**2)
    largest = np.quantile(squares, 1.0 - TRIM, axis=0, method="lower")
    return np.asarray(np.minimum(squares, largest).mean(axis=1))


def window_errors(errors: FloatArray, scale: FloatArray) -> FloatArray:
    """Returns the root mean square over the states of the scaled error, without a cap, (windows,)."""
    moved = scale > 0
    scaled = np.where(np.abs(errors) < 1e100, errors, np.inf)[:, moved] / scale[moved]
    return np.asarray(np.sqrt((scaled**2).mean(axis=1))) if moved.any() else np.zeros(len(errors))


def factors(windows: Windows, errors: FloatArray, scale: FloatArray) -> tuple[Factor, ...]:
    """Returns every variable with its bins, the one that explains most first.

    ``errors`` (windows, states): predicted - measured at the ends of the windows. Windows are assigned to bins by their
    mean (actions, states) or their middle (angles, position, time).
    """
    squares = window_squares(errors, scale)
    judge = _ErrorBinning(windows, errors, scale, squares)
    middle = windows.start + windows.steps // 2
    found = []
    for index, variable in enumerate(windows.system.state):
        values = windows.states[middle, index]
        if variable.angle:
            values = (values + np.pi) % (2 * np.pi) - np.pi
            edges = angle_edges()
        else:
            if variable.name not in POSITION:
                values = _mean(windows.states[:, index], windows.start, windows.end + 1)
            edges = round_edges(values)
        kind = "position" if variable.name in POSITION else "state"
        found.append(judge.factor(variable.name, variable.unit, kind, values, edges))
    for index, variable in enumerate(windows.system.action):
        values = _mean(windows.actions[:, index], windows.start, windows.end)
        found.append(judge.factor(variable.name, variable.unit, "action", values, round_edges(values)))
    found.append(judge.time(windows.time[middle]))
    return tuple(sorted(found, key=lambda item: -item.explained))


def cells(windows: Windows, errors: FloatArray, scale: FloatArray, smallest: int = 3) -> tuple[Cell, ...]:
    """Returns squares of the plane with at least ``smallest`` windows; empty for a system without x and y."""
    if not all(name in windows.system.state_names for name in POSITION):
        return ()
    x, y = window_positions(windows)
    width = float(np.diff(round_edges(np.concatenate([x - x.min(), y - y.min()]), most=14))[1:2].sum()) or 1.0
    column, row = np.floor(x / width).astype(np.int64), np.floor(y / width).astype(np.int64)
    squares = window_squares(errors, scale)
    total = float(squares.sum())
    found = []
    for i, j in sorted(set(zip(column.tolist(), row.tolist(), strict=True))):
        inside = (column == i) & (row == j)
        if inside.sum() >= smallest:
            error = scaled_error(trimmed_rms(errors[inside]), scale).value
            share = float(squares[inside].sum()) / total if total else 0.0
            edges = (i * width, (i + 1) * width, j * width, (j + 1) * width)
            found.append(Cell(*edges, error, share, int(inside.sum())))
    return tuple(sorted(found, key=lambda cell: -cell.error))


def window_positions(windows: Windows) -> tuple[FloatArray, FloatArray]:
    """Returns the position at the middle of each window, x and y (windows,) [m]."""
    names = windows.system.state_names
    middle = windows.start + windows.steps // 2
    x, y = (windows.states[middle, names.index(name)] for name in POSITION)
    return x, y


@dataclass(frozen=True)
class _ErrorBinning:
    windows: Windows
    errors: FloatArray
    scale: FloatArray
    squares: FloatArray

    def factor(self, name: str, unit: str, kind: str, values: FloatArray, edges: FloatArray) -> Factor:
        bins, groups = self._bins(name, unit, values, edges, np.ones(len(values), dtype=bool))
        return Factor(name, unit, kind, self._explained(groups), bins)

    def time(self, values: FloatArray) -> Factor:
        bins: list[Bin] = []
        groups: list[NDArray[np.bool_]] = []
        for index, run in enumerate(self.windows.names):
            members = self.windows.run == index
            if members.any():
                more, inside = self._bins("time", "s", values, round_edges(values[members]), members, run)
                bins += more
                groups += inside
        return Factor("time", "s", "time", self._explained(groups), tuple(bins))

    def _bins(
        self,
        name: str,
        unit: str,
        values: FloatArray,
        edges: FloatArray,
        members: NDArray[np.bool_],
        run: str | None = None,
    ) -> tuple[tuple[Bin, ...], list[NDArray[np.bool_]]]:
        # A bin needs 10 windows and 1 % of all: the error of fewer is mostly chance.
        edges = merge_small_bins(values[members], edges, smallest=max(10, int(0.01 * len(values))))
        which = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
        groups = [members & (which == index) for index in range(len(edges) - 1)]
        return tuple(
            self._bin(name, unit, float(edges[index]), float(edges[index + 1]), inside, run)
            for index, inside in enumerate(groups)
            if inside.any()
        ), groups

    def _bin(self, name: str, unit: str, low: float, high: float, inside: NDArray[np.bool_], run: str | None) -> Bin:
        error = scaled_error(trimmed_rms(self.errors[inside]), self.scale).value
        average = scaled_error(trimmed_rms(self.errors), self.scale).value
        total = float(self.squares.sum())
        bias = np.median(self.errors[inside], axis=0)
        return Bin(
            variable=name,
            unit=unit,
            low=low,
            high=high,
            error=error,
            ratio=error / average if average > 0 else float("nan"),
            share=float(self.squares[inside].sum()) / total if total else 0.0,
            samples=int(inside.sum()),
            bias=dict(zip(self.windows.system.state_names, bias.tolist(), strict=True)),
            run=run,
        )

    def _explained(self, groups: Sequence[NDArray[np.bool_]]) -> float:
        # Roots instead of squares: a few large errors would dominate the variance.
        roots = np.sqrt(self.squares)
        whole = float(((roots - roots.mean()) ** 2).sum())
        filled = [roots[inside] for inside in groups if inside.any()]
        if not whole > 0 or len(roots) <= len(filled):
            return 0.0
        within = sum(float(((part - part.mean()) ** 2).sum()) for part in filled)
        return 1.0 - (len(roots) - 1) / (len(roots) - len(filled)) * within / whole


def round_edges(values: FloatArray, most: int = 8) -> FloatArray:
    """Returns edges of at most ``most`` + 1 bins of one round width (1, 2, 2.5 or 5 times a power of ten).

    They span the middle 99 % of the values; the outer edges are moved to include the rest.
    """
    low, high = np.quantile(values, [0.005, 0.995])
    width = _round_width((high - low) / most)
    edges = np.arange(math.floor(low / width + 1e-9), math.ceil(high / width - 1e-9) + 1) * width
    if len(edges) < 2:
        edges = edges[0] + np.array([0.0, width])
    edges[0] = min(edges[0], math.floor(values.min() / width) * width)
    edges[-1] = max(edges[-1], math.ceil(values.max() / width) * width)
    return np.asarray(np.round(edges, 12))


def angle_edges(sectors: int = 8) -> FloatArray:
    """Returns edges of equal sectors from -pi to pi."""
    return np.linspace(-math.pi, math.pi, sectors + 1)


def merge_small_bins(values: FloatArray, edges: FloatArray, smallest: int) -> FloatArray:
    """Merges bins with fewer than ``smallest`` values into their right neighbours."""
    counts = np.histogram(values, edges)[0]
    retained, inside = [edges[0]], 0
    for count, upper in zip(counts, edges[1:], strict=True):
        inside += int(count)
        if inside >= smallest:
            retained.append(upper)
            inside = 0
    if len(retained) == 1:
        return np.array([edges[0], edges[-1]])
    retained[-1] = edges[-1]
    return np.array(retained)


def _round_width(width: float) -> float:
    # Constant values still need a bin.
    if not width > 1e-9:
        return 1.0
    power = 10.0 ** math.floor(math.log10(width))
    return float(next(factor * power for factor in (1.0, 2.0, 2.5, 5.0, 10.0) if factor * power >= width * (1 - 1e-9)))


def _mean(column: FloatArray, start: NDArray[np.int64], stop: NDArray[np.int64]) -> FloatArray:
    sums = np.concatenate([[0.0], np.cumsum(column)])
    return np.asarray((sums[stop] - sums[start]) / (stop - start))
