"""A grid of square cells around the robot that follows it in whole cells, and morphology on its flags."""

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
"""Edge of a cell, m."""


@final
class Grid:
    """A grid of (size, size) cells; the middle of cell [i, j] is ((i + 0.5 + left) CELL, (j + 0.5 + low) CELL)."""

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
        """x and y (size, size) [m] of the middles of the cells; read-only, and the same arrays until the grid moves."""
        if self._middles is None:
            x: FloatArray = (self._index[0] + (0.5 + self.left)) * CELL
            y: FloatArray = (self._index[1] + (0.5 + self.low)) * CELL
            x.flags.writeable = y.flags.writeable = False
            self._middles = x, y
        return self._middles

    def around(self, x: float, y: float, reach: float) -> tuple[slice, slice]:
        """Slices of the columns and rows within ``reach`` [m] of x and of y."""

        def near(place: float, first: int) -> slice:
            low, high = floor((place - reach) / CELL) - first, floor((place + reach) / CELL) - first
            return slice(max(low, 0), max(high + 1, 0))

        return near(x, self.left), near(y, self.low)

    def cells(self, places: FloatArray) -> tuple[IndexArray, IndexArray, BoolArray]:
        """Indices i, j of the cells of ``places`` (n, 2) [m], and which places are inside the grid."""
        i = np.floor(places[:, 0] / CELL).astype(np.int64) - self.left
        j = np.floor(places[:, 1] / CELL).astype(np.int64) - self.low
        return i, j, (i >= 0) & (i < self.size) & (j >= 0) & (j < self.size)

    def shift_to(self, x: float, y: float, slack: int) -> tuple[int, int]:
        """Cells by which the grid must move to be centred at (x, y) [m]; (0, 0) if it is within ``slack`` cells."""
        left, low = self._corner(x, y)
        way = left - self.left, low - self.low
        return way if max(map(abs, way)) > slack else (0, 0)

    def move(self, way: tuple[int, int]) -> None:
        """Moves by whole cells; the caller shifts each array of cell contents with ``shift_cells``."""
        self.left, self.low, self._middles = self.left + way[0], self.low + way[1], None


def shift_cells(cells: _A, way: tuple[int, int], new: Any) -> _A:
    """Shifts cell contents after the grid moved by ``way``; fills new cells with ``new``."""
    shifted: _A = np.full_like(cells, new)
    size = len(cells)
    target = [slice(max(0, -step), min(size, size - step)) for step in way]
    source = [slice(max(0, step), min(size, size + step)) for step in way]
    if all(part.start < part.stop for part in target):
        shifted[target[0], target[1]] = cells[source[0], source[1]]
    return shifted


@cache
def disc_offsets(radius: float) -> tuple[tuple[int, int, float], ...]:
    """Offsets (i, j) and distance [m] of all cells within ``radius`` [m] of a cell, nearest first."""
    cells = floor(radius / CELL + 1e-9)
    near = [(i, j, CELL * hypot(i, j)) for i in range(-cells, cells + 1) for j in range(-cells, cells + 1)]
    return tuple(sorted((one for one in near if one[2] <= radius + 1e-9), key=lambda one: one[2]))


def dilate(cells: BoolArray, radius: float, *, beyond: bool) -> BoolArray:
    """Flags all cells within ``radius`` [m] of a flagged one; ``beyond`` is the flag of cells outside the grid."""
    return _dilate(cells, radius, beyond=beyond)


def erode(cells: BoolArray, radius: float, *, beyond: bool) -> BoolArray:
    """Keeps flagged cells whose neighbours within ``radius`` [m] are all flagged; ``beyond``: flag outside the grid."""
    return ~_dilate(~cells, radius, beyond=not beyond)


def _dilate(cells: BoolArray, radius: float, *, beyond: bool) -> BoolArray:
    """Dilation with all cells packed into one big integer, so that a bit shift moves all cells at once.

    The rows are stored one after the other with padding. The disc is a stack of rows; from the outermost row inwards,
    the flags are grown along their row to the half length of that row, then shifted by its offset.
    """
    lengths, size = _row_lengths(radius), len(cells)
    pad = len(lengths) - 1
    if not pad:
        return cells.copy()
    wide = np.full((size + 2 * pad, size + pad), beyond)  # the padding after a row also precedes the next row
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
    """Half length in cells of each row of a disc with this radius [m], from its middle row outwards."""
    near: dict[int, int] = {}
    for i, j, _ in disc_offsets(radius):
        near[abs(i)] = max(near.get(abs(i), 0), abs(j))
    return tuple(near[row] for row in range(len(near)))
