"""How far someone has to walk around things at rest: ways on a grid, told no longer than they are."""

from __future__ import annotations

from math import ceil, gcd, hypot
from typing import Final, final

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from safedpa.arrays import BoolArray, FloatArray, IndexArray
from safedpa_sim.robots.scene import Scene
from safedpa_sim.sensing.shapes import Outline, Point, clearances_at

__all__ = ["WaysAround"]


_CELL: Final = 0.05
"""m"""
_STEPS: Final = tuple(
    (i, j) for i in range(-2, 3) for j in range(-2, 3) if (i or j) and gcd(i, j) == 1 and max(abs(i), abs(j)) <= 2
)
"""Sixteen directions: a way along them is up to 1.0275 times as long as the straight one."""
_LONGER: Final = 1.0275


@final
class WaysAround:
    """The places of a scene in which the middle of someone of ``radius`` [m] can be, and the ways between them.

    A cell is open if someone thinner by a cell has room in it, so that no way is found closed that is not.
    """

    def __init__(self, scene: Scene, radius: float) -> None:
        low_x, high_x, low_y, high_y = scene.field
        columns, rows = ceil((high_x - low_x) / _CELL), ceil((high_y - low_y) / _CELL)
        i, j = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
        self.places: FloatArray = np.column_stack(
            [low_x + (i.ravel() + 0.5) * _CELL, low_y + (j.ravel() + 0.5) * _CELL]
        )
        """(cells, 2) m; the cells' middles."""
        outline = Outline(scene.obstacles, scene.polygons, (scene.field,))
        open_cells = (clearances_at(outline, self.places) > radius - _CELL).reshape(columns, rows)
        starts, ends, lengths = list[IndexArray](), list[IndexArray](), list[FloatArray]()
        number = np.arange(columns * rows).reshape(columns, rows)
        for right, up in _STEPS:
            here = np.s_[max(-right, 0) : columns - max(right, 0), max(-up, 0) : rows - max(up, 0)]
            there = np.s_[max(right, 0) : columns - max(-right, 0), max(up, 0) : rows - max(-up, 0)]
            both = open_cells[here] & open_cells[there]
            starts.append(number[here][both])
            ends.append(number[there][both])
            lengths.append(np.full(int(both.sum()), _CELL * hypot(right, up)))
        table = np.concatenate(lengths), (np.concatenate(starts), np.concatenate(ends))
        self._graph = csr_array(table, shape=(columns * rows, columns * rows))
        self._open = open_cells.ravel()

    def to(self, place: Point, wanted: BoolArray, longest: float) -> float:
        """m that no one's way from ``place`` to any of the ``wanted`` (cells,) falls short of; ``longest`` [m] where
        there is none as short as that.

        A straight way between any two places is told shorter as well, by up to 3 % and 7 cm.
        """
        away = np.where(self._open, np.hypot(*(self.places - np.array(place)).T), np.inf)
        start = int(np.argmin(away))
        if not np.isfinite(away[start]):
            return 0.0
        found = dijkstra(self._graph, indices=start, limit=_LONGER * (longest + 2.0 * _CELL))[wanted]
        shortest = float(found.min()) if len(found) else float("inf")
        return min(max(shortest / _LONGER - float(away[start]) - _CELL / 2**0.5, 0.0), longest)
