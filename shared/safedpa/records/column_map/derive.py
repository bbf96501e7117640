"""Time derivatives of measured signals, central and so without phase shift."""

from __future__ import annotations

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.records.run import Stretch

__all__ = ["slope", "slopes_within"]


def slope(t: FloatArray, values: FloatArray, window: float) -> FloatArray:
    """d(values)/dt at every row, shape (rows,): sum_j j values[i+j] / sum_j j t[i+j], j from -m to m.

    With even sampling this is the least-squares slope over 2 m + 1 rows; m rows span window / 2 [s], at least one.
    It is central, so without phase shift, and exact for a parabola; a sine of f [Hz] keeps about
    1 - (pi f window)^2 / 10 of its slope. NaN in the first and last m rows, where the window does not fit.
    (Savitzky and Golay, 1964: smoothing and differentiation by least squares, first derivative.)
    """
    rows = len(t)
    half = max(1, round(window / 2.0 / float(np.median(np.diff(t))))) if rows > 1 else 1
    result = np.full(rows, np.nan)
    if rows >= 2 * half + 1:
        weights = np.arange(half, -half - 1, -1, dtype=np.float64)
        finite = values[np.isfinite(values)]
        offset = float(finite[0]) if len(finite) else 0.0  # subtract a value first: large numbers lose digits
        change = np.convolve(values - offset, weights, "valid")
        result[half : rows - half] = change / np.convolve(t - t[0], weights, "valid")
    return result


def slopes_within(t: FloatArray, values: FloatArray, stretches: list[Stretch], window: float) -> FloatArray:
    """d(values)/dt within each stretch, shape (rows,); NaN outside and for missing values."""
    result = np.full(len(t), np.nan)
    for stretch in stretches:
        inner = np.flatnonzero(np.isfinite(values[stretch.start : stretch.stop])) + stretch.start
        result[inner] = slope(t[inner], values[inner], window)
    return result
