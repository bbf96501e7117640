"""Square cells around the robot, in the frame of its position, that follow it in whole cells."""

from __future__ import annotations

from functools import cache
from math import ceil, floor, hypot
from typing import Any, TypeVar, final

import numpy as np
from numpy.typing import NDArray

__all__ = ["CELL", "Grid", "disc_offsets", "grown", "moved", "shrunk"]

Values = NDArray[np.float64]
Flags = NDArray[np.bool_]
Whole = NDArray[np.int64]
_A = TypeVar("_A", bound=NDArray[Any])

CELL = 0.1
"""m"""


@final
class Grid:
    """(size, size) cells; cell [i, j] has its middle at ((i + 0.5 + left) CELL, (j + 0.5 + low) CELL)."""

    def __init__(self, reach: float, x: float, y: float) -> None:
        self.size = 2 * ceil(reach / CELL) + 1
        self.left, self.low = self._corner(x, y)
        index = np.arange(self.size, dtype=np.float64)
        self._index = np.meshgrid(index, index, indexing="ij")

    def _corner(self, x: float, y: float) -> tuple[int, int]:
        return floor(x / CELL) - self.size // 2, floor(y / CELL) - self.size // 2

    @property
    def middles(self) -> tuple[Values, Values]:
        """x and y (size, size) [m] of the cells' middles."""
        x: Values = (self._index[0] + (0.5 + self.left)) * CELL
        y: Values = (self._index[1] + (0.5 + self.low)) * CELL
        return x, y

    def cells(self, places: Values) -> tuple[Whole, Whole, Flags]:
        """Indices of the cells that ``places`` (n, 2) [m] lie in, and which of them lie in one at all."""
        i = np.floor(places[:, 0] / CELL).astype(np.int64) - self.left
        j = np.floor(places[:, 1] / CELL).astype(np.int64) - self.low
        return i, j, (i >= 0) & (i < self.size) & (j >= 0) & (j < self.size)

    def way_to(self, x: float, y: float, slack: int) -> tuple[int, int]:
        """Cells by which it has to move so that (x, y) [m] is in its middle again; (0, 0) while it nearly is."""
        left, low = self._corner(x, y)
        way = left - self.left, low - self.low
        return way if max(map(abs, way)) > slack else (0, 0)

    def move(self, way: tuple[int, int]) -> None:
        """By whole cells; every array is to be moved by ``moved``, too."""
        self.left, self.low = self.left + way[0], self.low + way[1]


def moved(cells: _A, way: tuple[int, int], new: Any) -> _A:
    """What was in ``cells`` before its grid moved by ``way``; ``new`` in what came in."""
    fresh: _A = np.full_like(cells, new)
    size = len(cells)
    here = [slice(max(0, -step), min(size, size - step)) for step in way]
    there = [slice(max(0, step), min(size, size + step)) for step in way]
    if all(part.start < part.stop for part in here):
        fresh[here[0], here[1]] = cells[there[0], there[1]]
    return fresh


@cache
def disc_offsets(radius: float) -> tuple[tuple[int, int, float], ...]:
    """Cells whose middles lie within ``radius`` [m] of one's own, with the distance [m]; the own one first."""
    cells = floor(radius / CELL + 1e-9)
    near = [(i, j, CELL * hypot(i, j)) for i in range(-cells, cells + 1) for j in range(-cells, cells + 1)]
    return tuple(sorted((one for one in near if one[2] <= radius + 1e-9), key=lambda one: one[2]))


def grown(cells: Flags, radius: float, *, beyond: bool) -> Flags:
    """All cells within ``radius`` [m] of a flagged one; ``beyond``: whether what lies outside of the grid is."""
    return _joined(cells, radius, beyond=beyond)


def shrunk(cells: Flags, radius: float, *, beyond: bool) -> Flags:
    """Flagged cells around which all within ``radius`` [m] are, too; ``beyond``: whether those outside are."""
    return ~_joined(~cells, radius, beyond=not beyond)


def _joined(cells: Flags, radius: float, *, beyond: bool) -> Flags:
    pad = floor(radius / CELL + 1e-9)
    size = len(cells)
    wide = np.full((size + 2 * pad, size + 2 * pad), beyond)
    wide[pad : pad + size, pad : pad + size] = cells
    found = cells.copy()
    for i, j, _ in disc_offsets(radius)[1:]:
        found |= wide[pad + i : pad + i + size, pad + j : pad + j + size]
    return found
