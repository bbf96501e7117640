"""Bins with round edges that all contain enough values."""

from __future__ import annotations

import math

import numpy as np

from safedpa.arrays import FloatArray


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
