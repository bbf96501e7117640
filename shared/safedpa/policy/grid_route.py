"""A route around sensed surroundings for any planar robot: distances to the goal on a grid, and the way along them.

``grid_distances`` solves D(cell) = min over neighbours of (weighted way + D(neighbour)). ``GridRoute`` weighs the
cells by what perception reports: near objects at rest a metre counts more, near movers and hidden places as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.bus import SurroundingsMessage

__all__ = ["GridRoute", "PlanningGrid", "grid_distances"]

_NEAR = ((1, 0), (-1, 0), (0, 1), (0, -1))
_DIAGONAL = ((1, 1), (1, -1), (-1, 1), (-1, -1))
_CELL: Final = 0.1
"""m"""
_BEYOND, _FARTHEST = 1.5, 7.0
"""m around robot and goal; a goal farther away is replaced by a point at this distance towards it."""
_THROUGH, _GRAZING, _BERTH = 25.0, 3.0, 0.25
"""Cost factor where the body does not fit; further cost at contact, which falls to 0 at this clearance [m]."""
_SHY, _SHY_BERTH = 3.0, 0.7
"""The same for movers and hidden places, which slow the robot down."""
_AGAIN: Final = 0.2
"""s between two maps."""
_STEPS: Final = 3
"""Cells ahead at which the robot aims."""


class PlanningGrid:
    """Grid lines x (nx,), y (ny,) at most ``cell`` apart over a field (low x, high x, low y, high y) [m]."""

    def __init__(self, field: Sequence[float], cell: float) -> None:
        west, east, south, north = field
        columns, rows = (max(2, int(np.ceil((high - low) / cell)) + 1) for low, high in ((west, east), (south, north)))
        self.x: FloatArray = np.linspace(west, east, columns)
        self.y: FloatArray = np.linspace(south, north, rows)
        self.cell: FloatArray = np.array((self.x[1] - self.x[0], self.y[1] - self.y[0]))

    def shares(self, position: FloatArray, axis: int) -> tuple[NDArray[np.intp], FloatArray]:
        """Returns the index of the grid line below each coordinate (any shape) and the weight of the next, clipped."""
        lines = self.x if axis == 0 else self.y
        at = np.clip((position - lines[0]) / self.cell[axis], 0.0, len(lines) - 1 - 1e-9)
        low = at.astype(np.intp)
        return low, at - low


def grid_distances(grid: PlanningGrid, goal: Sequence[float], weight: FloatArray) -> FloatArray:
    """Returns D (nx, ny), the weighted shortest distance to the goal over the eight neighbours of each cell.

    ``weight`` (nx, ny) >= 1 is the cost per metre. All cells are relaxed at once until nothing changes (Bellman-Ford).
    """
    distance = np.hypot(grid.x[:, None] - goal[0], grid.y[None, :] - goal[1])
    framed = np.full((weight.shape[0] + 2, weight.shape[1] + 2), np.inf)
    inside = framed[1:-1, 1:-1]
    inside[:] = np.where(distance <= np.hypot(*grid.cell) + distance.min(), distance, np.inf)
    ways = [
        (
            framed[1 + i : framed.shape[0] - 1 + i, 1 + j : framed.shape[1] - 1 + j],
            float(np.hypot(i * grid.cell[0], j * grid.cell[1])) * weight,
        )
        for i, j in _NEAR + _DIAGONAL
    ]
    while True:
        before = inside.copy()
        for neighbour, way in ways:
            np.minimum(inside, neighbour + way, out=inside)
        if np.array_equal(before, inside):
            return before


@final
class GridRoute:
    """The direction to drive in for a body of ``radius`` [m]; call ``look`` with the surroundings of each state."""

    def __init__(self, radius: float) -> None:
        self._radius = radius
        self._seen: SurroundingsMessage | None = None
        self._taken = -np.inf
        self._goal: tuple[float, ...] = ()
        self._grid: PlanningGrid | None = None
        self._distances: FloatArray = np.empty((0, 0))

    @property
    def knows(self) -> bool:
        """Whether any surroundings have arrived."""
        return self._seen is not None

    def look(self, seen: SurroundingsMessage | None) -> None:
        """Sets the surroundings for the next state; None keeps the last ones."""
        self._seen = seen if seen is not None else self._seen

    def aim(self, position: tuple[float, float], goal: Sequence[float], now: float) -> tuple[float, float]:
        """Returns the point x, y [m] to drive to next, at time ``now`` [s]."""
        if not 0.0 <= now - self._taken < _AGAIN or tuple(goal) != self._goal or self._grid is None:
            self._map(position, goal)
            self._taken, self._goal = now, tuple(goal)
        assert self._grid is not None
        grid, table = self._grid, self._distances
        i = int(np.abs(grid.x - position[0]).argmin())
        j = int(np.abs(grid.y - position[1]).argmin())
        for _ in range(_STEPS):
            near = [(i + a, j + b) for a, b in _NEAR + _DIAGONAL]
            inside = [(a, b) for a, b in near if 0 <= a < len(grid.x) and 0 <= b < len(grid.y)]
            best = min(inside, key=lambda cell: table[cell])
            if table[best] >= table[i, j]:
                break
            i, j = best
        if hypot(goal[0] - position[0], goal[1] - position[1]) < 2.0 * _CELL:
            return goal[0], goal[1]
        return float(grid.x[i]), float(grid.y[j])

    def _map(self, position: tuple[float, float], goal: Sequence[float]) -> None:
        apart = np.array(goal[:2]) - position
        towards = np.array(position) + apart * min(1.0, _FARTHEST / max(float(np.hypot(*apart)), 1e-6))
        low, high = np.minimum(position, towards) - _BEYOND, np.maximum(position, towards) + _BEYOND
        grid = self._grid = PlanningGrid((low[0], high[0], low[1], high[1]), _CELL)
        seen = self._seen
        weight = np.ones((len(grid.x), len(grid.y)))
        if seen is not None:
            rest = self._clearance(grid, seen.points)
            shy = np.minimum(self._clearance(grid, seen.movers), self._clearance(grid, seen.hidden))
            weight += _GRAZING * np.clip(1.0 - rest / _BERTH, 0.0, 1.0)
            weight += _SHY * np.clip(1.0 - shy / _SHY_BERTH, 0.0, 1.0)
            weight[rest < 0.0] = _THROUGH
        self._distances = grid_distances(grid, tuple(towards.tolist()), weight)

    def _clearance(self, grid: PlanningGrid, rows: Sequence[Sequence[float]]) -> FloatArray:
        """Returns the distance (nx, ny) [m] of the body at each grid point from the nearest disc."""
        table = np.array([row[:3] for row in rows], dtype=np.float64).reshape(-1, 3)
        if not len(table):
            return np.full((len(grid.x), len(grid.y)), 100.0)
        x, y = (grid.x[:, None] - table[:, 0])[:, None, :], (grid.y[:, None] - table[:, 1])[None, :, :]
        found: FloatArray = (np.sqrt(x * x + y * y) - table[:, 2]).min(axis=-1) - self._radius
        return found
