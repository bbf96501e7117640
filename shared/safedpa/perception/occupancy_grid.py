"""Square cells around the robot, in the frame of its position, that follow it in whole cells."""

from __future__ import annotations

from functools import cache
from math import ceil, floor, hypot
from typing import Any, TypeVar, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray, IndexArray

__all__ = ["CELL", "Grid", "dilate", "disc_offsets", "erode", "shift_cells"]

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
        self._middles: tuple[FloatArray, FloatArray] | None = None

    def _corner(self, x: float, y: float) -> tuple[int, int]:
        return floor(x / CELL) - self.size // 2, floor(y / CELL) - self.size // 2

    @property
    def middles(self) -> tuple[FloatArray, FloatArray]:
        """x and y (size, size) [m] of the cells' middles; not writeable, the same arrays until it moves."""
        if self._middles is None:
            x: FloatArray = (self._index[0] + (0.5 + self.left)) * CELL
            y: FloatArray = (self._index[1] + (0.5 + self.low)) * CELL
            x.flags.writeable = y.flags.writeable = False
            self._middles = x, y
        return self._middles

    def around(self, x: float, y: float, reach: float) -> tuple[slice, slice]:
        """Of columns and rows those whose cells come within ``reach`` [m] of x and of y."""

        def near(place: float, first: int) -> slice:
            low, high = floor((place - reach) / CELL) - first, floor((place + reach) / CELL) - first
            return slice(max(low, 0), max(high + 1, 0))

        return near(x, self.left), near(y, self.low)

    def cells(self, places: FloatArray) -> tuple[IndexArray, IndexArray, BoolArray]:
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
        """By whole cells; every array is to be moved by ``shift_cells``, too."""
        self.left, self.low, self._middles = self.left + way[0], self.low + way[1], None


def shift_cells(cells: _A, way: tuple[int, int], new: Any) -> _A:
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


def dilate(cells: BoolArray, radius: float, *, beyond: bool) -> BoolArray:
    """All cells within ``radius`` [m] of a flagged one; ``beyond``: whether what lies outside of the grid is."""
    return _joined(cells, radius, beyond=beyond)


def erode(cells: BoolArray, radius: float, *, beyond: bool) -> BoolArray:
    """Flagged cells around which all within ``radius`` [m] are, too; ``beyond``: whether those outside are."""
    return ~_joined(~cells, radius, beyond=not beyond)


def _joined(cells: BoolArray, radius: float, *, beyond: bool) -> BoolArray:
    """As one whole number of many bits, row after row with room between them: a shift moves all cells at once.

    A disc is rows of cells, the shorter the farther they are from its middle: from the outermost row on, the cells grow
    along their rows to its length, and are moved to it.
    """
    lengths, size = _row_lengths(radius), len(cells)
    pad = len(lengths) - 1
    if not pad:
        return cells.copy()
    wide = np.full((size + 2 * pad, size + pad), beyond)  # what lies beyond one row's end lies before the next
    wide[pad : pad + size, :size] = cells
    row, margin = size + pad, pad * (size + pad + 1)
    length = 0
    grown_along = bits = int.from_bytes(np.packbits(wide, bitorder="little").tobytes(), "little") << margin
    found = 0
    for away in range(pad, -1, -1):
        while length < lengths[away]:
            length += 1
            grown_along |= (bits << length) | (bits >> length)
        found |= (grown_along << (away * row)) | (grown_along >> (away * row))
    found >>= margin + pad * row
    packed = (found & ((1 << (size * row)) - 1)).to_bytes((size * row + 7) // 8, "little")
    flags = np.unpackbits(np.frombuffer(packed, np.uint8), count=size * row, bitorder="little")
    return flags.reshape(size, row)[:, :size].view(np.bool_).copy()


@cache
def _row_lengths(radius: float) -> tuple[int, ...]:
    """By rows from the middle of a disc of this radius [m]: how many cells it reaches to either side there."""
    near: dict[int, int] = {}
    for i, j, _ in disc_offsets(radius):
        near[abs(i)] = max(near.get(abs(i), 0), abs(j))
    return tuple(near[row] for row in range(len(near)))
