"""The way to the goal around the obstacles for a disc: what a planner begins with when it gets a new goal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["Grid", "disc_ways"]

Values = NDArray[np.float64]

_NEAR = ((1, 0), (-1, 0), (0, 1), (0, -1))
_DIAGONAL = ((1, 1), (1, -1), (-1, 1), (-1, -1))


class Grid:
    """Places x (nx,), y (ny,) at most ``cell`` apart, edge to edge of a field (low x, high x, low y, high y) [m]."""

    def __init__(self, field: Sequence[float], cell: float) -> None:
        west, east, south, north = field
        columns, rows = (max(2, int(np.ceil((high - low) / cell)) + 1) for low, high in ((west, east), (south, north)))
        self.x: Values = np.linspace(west, east, columns)
        self.y: Values = np.linspace(south, north, rows)
        self.cell: Values = np.array((self.x[1] - self.x[0], self.y[1] - self.y[0]))

    def shares(self, place: Values, axis: int) -> tuple[NDArray[np.intp], Values]:
        """Index of the grid line below each place (any shape) and the share of the next one, held at the edges."""
        lines = self.x if axis == 0 else self.y
        at = np.clip((place - lines[0]) / self.cell[axis], 0.0, len(lines) - 1 - 1e-9)
        low = at.astype(np.intp)
        return low, at - low


def disc_ways(grid: Grid, goal: Sequence[float], weight: Values) -> Values:
    """D (nx, ny): the least D with D(c) <= D(n) + |c - n| w(c) for all eight neighbours n; the distance at the goal.

    ``weight`` (nx, ny) >= 1 is what a metre counts. Relaxed for all cells at a time until nothing changes (Bellman and
    Ford).
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
