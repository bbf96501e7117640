"""Barriers from a map: a grid of distances, or of occupied cells.

Between the centres of cells the distance is interpolated bilinearly. With p the reference point, r the robot's radius
and d the cell size

    h(x) = distance(p) - d / sqrt(2) - r

where d / sqrt(2) bounds the error of interpolation: a distance changes by at most 1 per metre, and no point is further
from the four centres around it, weighted as they are interpolated. What lies outside the map counts as occupied.
"""

from __future__ import annotations

from math import sqrt
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.between_ticks import LipschitzBarrier
from safedpa.safety.validation import checked_output

__all__ = ["DistanceFieldBarrier", "distance_to_occupied"]


@final
class DistanceFieldBarrier(AbstractBarrier):
    """h(x) from a grid of distances to the nearest obstacle; see the module's equation.

    ``distance`` (rows, columns) [m] at the centres of the cells, row i at y = origin_y + i cell, column j at
    x = origin_x + j cell; negative inside obstacles, and it may be truncated at any value. ``position`` are the indices
    of x and y in the state. ``radius`` [m] >= 0 is that of the robot.

    Use it inside ``bounded``, which adds the bound between two ticks that a truncated field needs. Raises InputError
    for a grid smaller than 2 x 2, values that are not finite, and cells or radii that are not positive.

    >>> field = safedpa.DistanceFieldBarrier(np.full((40, 40), 3.0), cell=0.1, radius=0.2)
    >>> field.h(np.array([2.0, 2.0])).round(2).tolist()
    [1.73]
    """

    def __init__(
        self,
        distance: ArrayLike,
        cell: float,
        origin: tuple[float, float] = (0.0, 0.0),
        radius: float = 0.0,
        position: tuple[int, int] = (0, 1),
        name: str = "map",
        kind: str = "obstacle",
    ) -> None:
        grid = checked_output("distance", distance)
        if grid.ndim != 2 or min(grid.shape) < 2 or not np.isfinite(grid).all():
            raise InputError(f"distance: got shape {grid.shape}, wanted (rows, columns) finite numbers, 2 x 2 or more")
        for what, value, low in (("cell", cell, np.nextafter(0.0, 1.0)), ("radius", radius, 0.0)):
            if not low <= value < np.inf:
                raise InputError(f"{what}: got {value!r}, wanted a finite number {'> 0' if what == 'cell' else '>= 0'}")
        self.names, self.kind = (name,), kind
        self._cell, self._origin, self._position = float(cell), np.asarray(origin, dtype=np.float64), position
        # Distance to the outside, of which the map says nothing; two cells of frame continue it.
        to_edge = [np.minimum(np.arange(n), np.arange(n)[::-1]) - 1.0 for n in (grid.shape[0] + 4, grid.shape[1] + 4)]
        edge = self._cell * np.minimum.outer(*to_edge)
        known = np.minimum(np.pad(grid, 2, constant_values=np.inf), edge)
        self._grid = known - self._cell / sqrt(2.0) - radius

    @property
    def lipschitz_constant(self) -> float:
        """The largest |d(h)/d(x, y)|: sqrt(2) times the largest difference of neighbouring cells, per metre."""
        steps = max(float(np.abs(np.diff(self._grid, axis=axis)).max()) for axis in (0, 1))
        return sqrt(2.0) * max(1.0, steps / self._cell)

    def bounded(self, states: int) -> LipschitzBarrier:
        """This barrier with its bound between two ticks, for a state with so many entries."""
        lipschitz = np.zeros(states)
        lipschitz[list(self._position)] = self.lipschitz_constant
        return LipschitzBarrier(self, lipschitz)

    def h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return self.h_and_grad(state)[0]

    def h_and_grad(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: D102
        # + 2.0: the frame of two cells shifts every index of the map.
        column, row = (state[list(self._position)] - self._origin) / self._cell + 2.0
        rows, columns = self._grid.shape
        # The last cell of the frame continues outwards without slope.
        row, column = min(max(row, 0.0), rows - 1.0), min(max(column, 0.0), columns - 1.0)
        # On the last row or column the cell before it is used, because interpolation needs four corners.
        i, j = min(int(row), rows - 2), min(int(column), columns - 2)
        u, v = row - i, column - j
        corners = self._grid[i : i + 2, j : j + 2]
        h = (1 - u) * ((1 - v) * corners[0, 0] + v * corners[0, 1]) + u * ((1 - v) * corners[1, 0] + v * corners[1, 1])
        along_x = (1 - u) * (corners[0, 1] - corners[0, 0]) + u * (corners[1, 1] - corners[1, 0])
        along_y = (1 - v) * (corners[1, 0] - corners[0, 0]) + v * (corners[1, 1] - corners[0, 1])
        gradient = np.zeros((1, len(state)))
        gradient[0, list(self._position)] = np.array([along_x, along_y]) / self._cell
        return np.array([h]), gradient


def distance_to_occupied(occupied: ArrayLike, cell: float) -> FloatArray:
    """A lower bound of the signed distance [m] (rows, columns) from each cell's centre to the occupied cells of a map.

    ``occupied`` (rows, columns) of booleans: mark cells that nothing is known about as occupied. It is the distance to
    the nearest occupied centre less cell / sqrt(2), since an obstacle may fill its cell up to the corners; inside
    obstacles it falls with the distance to the nearest free centre. Needs SciPy (extra ``diagnosis``). Raises
    InputError for anything but a table of booleans.

    >>> safedpa.distance_to_occupied(np.array([[True, False, False]]), 1.0).round(2).tolist()
    [[-1.71, 0.29, 1.29]]
    """
    from scipy import ndimage

    cells = np.asarray(occupied)
    if cells.ndim != 2 or cells.dtype != np.bool_:
        raise InputError(f"occupied: got {cells.dtype} of shape {cells.shape}, wanted (rows, columns) of booleans")
    if not cells.any():
        # Without an obstacle the map ends free; its frame is what bounds it.
        return np.full(cells.shape, cell * float(np.hypot(*cells.shape)))
    outside = ndimage.distance_transform_edt(~cells)
    # Without a free cell there is no distance to one, and any positive depth keeps h negative.
    inside = ndimage.distance_transform_edt(cells) if not cells.all() else np.full(cells.shape, 1.0)
    return np.asarray(cell * (outside - inside - 1.0 / sqrt(2.0)))
