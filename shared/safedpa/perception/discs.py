"""Few discs that cover many places: one each where they are near, one for a block of them where they are far.

Nothing is left out: where there would still be too many, all blocks grow. So what is told errs on the safe side only.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.perception.grid import CELL

__all__ = ["covering"]

Values = NDArray[np.float64]

_NEAR = 1.5
"""m; up to here each place has a disc of its own, up to twice as far a block of 2 x 2 cells, and so on."""
_LEVELS = 2
"""Blocks of 4 x 4 cells at most, unless there is too much of it."""
_SPAN = 2**20
"""More blocks than a robot meets along a line, so that column and row make one number."""


def covering(places: Values, radii: Values, here: Values, most: int) -> Values:
    """Discs (m, 3) x, y, radius [m], m <= ``most``, that cover those of ``radii`` (n,) at ``places`` (n, 2) [m].

    The nearest to ``here`` (2,) first.
    """
    if not len(places):
        return np.empty((0, 3))
    ring = np.floor(np.hypot(*(places - here).T) / _NEAR).astype(np.int64)
    level, coarser = np.minimum(ring, _LEVELS), 0
    while len(found := _blocks(places, radii, level)) > most:
        coarser += 1  # the far ones first
        level = np.minimum(np.maximum(ring + coarser - _LEVELS, 0), _LEVELS + coarser)
        level = np.maximum(level, np.minimum(ring, _LEVELS))
    order = np.argsort(np.hypot(found[:, 0] - here[0], found[:, 1] - here[1]) - found[:, 2])
    return found[order]


def _blocks(places: Values, radii: Values, level: NDArray[np.int64]) -> Values:
    """One disc for all places of a level in the same block of 2^level x 2^level cells."""
    edge = CELL * 2.0**level
    column, row = (np.floor(places[:, axis] / edge).astype(np.int64) for axis in (0, 1))
    key = (level * _SPAN + column % _SPAN) * _SPAN + row % _SPAN
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    low, high = np.minimum.reduceat(places[order], starts), np.maximum.reduceat(places[order], starts)
    middle, reach = 0.5 * (low + high), np.maximum.reduceat(radii[order], starts)
    return np.column_stack([middle, reach + 0.5 * np.hypot(*(high - low).T)])
