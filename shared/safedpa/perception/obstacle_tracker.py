"""What was seen around the robot, on cells: what is at rest, what may move, and what was seen to be empty.

A cell that is hit for the first time holds something at rest where nothing that moves can have come (``hiding``),
next to what has long been at rest (noise), and, of cells that no one ever saw empty, next to what is at rest: more of the
same thing comes into view. It holds something that may move where something hidden may have come, until it has stayed
``still_after``; and where it was seen to be empty before, something that was seen to move, until it has stayed
``restless``. What is seen through is empty; what may move and is not seen again is empty too, since it either is seen
elsewhere or hides (``leaves``).
"""

from __future__ import annotations

from math import inf
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray
from safedpa.perception.occlusion import OcclusionMap
from safedpa.perception.occupancy_grid import CELL, Grid, dilate, shift_cells
from safedpa.perception.scan import BEHIND, ScanRays
from safedpa.perception.settings import PerceptionSettings

__all__ = ["ObstacleTracker"]


_WIDTH = 0.06
"""m around the middle through which every ray must pass."""
_ALONGSIDE = 1.5 * CELL
"""m; noise throws a point so far."""
_SLACK = 8
"""Cells by which the robot leaves the grid's middle before the grid follows."""
_LONG = 0.5
"""s at rest, after which something is solid: no one hides in it, and noise about it is nothing new."""
_UNSEEN = 0.25
"""s after which something that may move is not where it was seen: two scans at 10 Hz missed it."""
_GOES_ON = 0.3
"""m that something goes on from scan to scan at most, and a bit: 1.5 m/s at 10 Hz, and where on its body it is hit."""
_FRESH = 0.3
"""Share of a new point in a cell's mean."""


@final
class ObstacleTracker:
    """The cells' contents, in the frame of the robot's position."""

    def __init__(self, settings: PerceptionSettings, x: float, y: float) -> None:
        self.settings = settings
        self.grid = Grid(settings.reach, x, y)
        size = self.grid.size
        self.hiding = OcclusionMap(size, settings.slimmest, settings.fastest)
        self.first: FloatArray = np.full((size, size), inf)
        """s; when what is in a cell was first seen there; infinity: nothing is."""
        self.last: FloatArray = np.full((size, size), -inf)
        """s; when it was seen last."""
        self.driven = 0.0
        """m that the robot drove so far."""
        self.seen_at: FloatArray = np.zeros((size, size))
        """m that it had driven when a cell's content was seen last."""
        self._moved: FloatArray = np.full((size, size), -inf)
        """s; when it was last seen to move."""
        self._doubtful: BoolArray = np.zeros((size, size), dtype=bool)
        """Whether it may be something that had been hidden."""
        self._by: dict[str, BoolArray] = {}
        """By source: the cells whose content it has hit, and not seen through since."""
        self._emptied: dict[str, BoolArray] = {}
        """By source: the cells that it ever saw empty."""
        self._x, self._y = (middles.copy() for middles in self.grid.middles)
        self.contradicted = 0.0
        """Share of the cells hit by the last sweep whose content may move; 0 while no one knows what is at rest."""
        self.lost: FloatArray = np.empty((0, 2))
        """(n, 2) m; where the last sweep gave up someone who moved, with no one seen next to: he went out of sight."""
        self._began: float | None = None
        self._newest: dict[str, float] = {}
        """By source: s; when its newest sweep was measured."""

    def follow(self, x: float, y: float) -> None:
        """Moves the grid with the robot."""
        way = self.grid.way_to(x, y, _SLACK)
        if way == (0, 0):
            return
        self.grid.move(way)
        self.hiding.move(way)
        self.first, self.last = shift_cells(self.first, way, inf), shift_cells(self.last, way, -inf)
        self._moved, self.seen_at = shift_cells(self._moved, way, -inf), shift_cells(self.seen_at, way, 0.0)
        for flags in (self._by, self._emptied):
            flags.update({source: shift_cells(cells, way, False) for source, cells in flags.items()})
        self._doubtful = shift_cells(self._doubtful, way, False)
        middles = self.grid.middles
        self._x, self._y = shift_cells(self._x, way, 0.0), shift_cells(self._y, way, 0.0)
        empty = self.first == inf
        self._x[empty], self._y[empty] = middles[0][empty], middles[1][empty]

    def take(self, sweep: ScanRays, own: BoolArray) -> None:
        """Takes up one sweep; ``own`` (size, size): where the robot itself is."""
        time = sweep.time
        moved_before = self.moving(time)
        middles = self.grid.middles
        distance, sight = sweep.sight(*middles, _WIDTH)
        i, j, within = self.grid.cells(sweep.ends)
        i, j, ends = i[within], j[within], sweep.ends[within]
        least = self.settings.min_points_of(sweep.source)
        if least > 1:
            enough = _around(i, j, self.grid.size) >= least
            i, j, ends = i[enough], j[enough], ends[enough]
        hit = np.zeros_like(own)
        hit[i, j] = True
        seen = (distance < sight - BEHIND) & ~hit
        empty = seen & ~dilate(
            hit, _ALONGSIDE, beyond=False
        )  # along a wall one sees far past what stands next to the ray
        self._forget(empty, sweep)
        self._add(hit, sweep)
        self._place(i, j, ends)
        moving = self.moving(time)
        self._began = time if self._began is None else self._began
        self._newest[sweep.source] = max(self._newest.get(sweep.source, -inf), time)
        knows = time > self._began + 2.0 * _LONG
        self.contradicted = float((hit & moving).sum() / max(hit.sum(), 1)) if knows else 0.0
        past = sweep.farthest_past(*middles, self.hiding.width)
        looked_through = (distance < past - BEHIND) & ~hit
        looked_through |= dilate(hit & moving, CELL, beyond=False) & (distance < sight)
        self.hiding.look(time, looked_through, self._solid(time, self.at_rest(time, moving)), own, moving)
        self._emptied[sweep.source] |= empty
        unseen = moving & (self.last < time - _UNSEEN)
        self._clear(unseen)
        gone = moved_before & (self.first == inf)  # not seen for long, or a ray goes on past where he was
        self.lost = self.places(gone & ~dilate(moving & ~unseen, _GOES_ON, beyond=False))

    def _solid(self, time: float, at_rest: BoolArray) -> BoolArray:
        return at_rest & (self.first <= time - _LONG)

    def _forget(self, empty: BoolArray, sweep: ScanRays) -> None:
        """What a source sees through is gone once every source that hit it does: one may look over a low thing."""
        time, none = sweep.time, np.zeros_like(empty)
        for flags in (self._by, self._emptied):
            flags.setdefault(sweep.source, none.copy())
        mine = empty & (self.last <= time)
        self._by[sweep.source][mine] = False
        held = np.logical_or.reduce(list(self._by.values()))
        self._clear((mine & ~held) | (self.last < time - self.settings.memory))

    def _clear(self, gone: BoolArray) -> None:
        self.first[gone], self.last[gone], self._moved[gone] = inf, -inf, -inf
        self._doubtful[gone] = False
        for cells in self._by.values():
            cells[gone] = False

    def _add(self, hit: BoolArray, sweep: ScanRays) -> None:
        """Says of each cell that is hit for the first time what it holds."""
        own, time, emptied = self.settings, sweep.time, self._emptied[sweep.source]
        new = hit & (self.first == inf)
        at_rest = self.at_rest(time, self.moving(time))
        alongside = dilate(self._solid(time, at_rest), _ALONGSIDE, beyond=False)
        alongside |= dilate(at_rest, _ALONGSIDE, beyond=False) & ~emptied
        appeared = new & ~alongside & emptied
        came = new & ~alongside & ~appeared & dilate(self.hiding.reached(time), own.widest, beyond=True)
        restless = dilate(self._moved > time - own.restless, _ALONGSIDE, beyond=False)
        self._moved[appeared | (new & ~alongside & restless)] = time
        self._doubtful[came] = True
        self.first[new] = time
        self.last[hit] = np.maximum(self.last[hit], time)
        self.seen_at[hit] = self.driven
        self._by[sweep.source] |= hit

    def _place(self, i: NDArray[np.int64], j: NDArray[np.int64], ends: FloatArray) -> None:
        """Moves each cell's mean towards its points; of a cell that was empty, to their mean."""
        flat = i * self.grid.size + j
        cells, where = np.unique(flat, return_inverse=True)
        count = np.bincount(where)
        for mean, column in ((self._x, ends[:, 0]), (self._y, ends[:, 1])):
            fresh = np.bincount(where, weights=column) / count
            known = mean.ravel()[cells]
            started = self.first.ravel()[cells] >= self.last.ravel()[cells]
            mean.ravel()[cells] = np.where(started, fresh, known + _FRESH * (fresh - known))

    def moving(self, time: float) -> BoolArray:
        """(size, size) cells that hold something that may move."""
        own = self.settings
        doubtful = self._doubtful & (time - self.first < own.still_after)
        return (self.first < inf) & (doubtful | (self._moved > time - own.restless))

    def moving_now(self, time: float, moving: BoolArray | None = None) -> BoolArray:
        """Those of ``moving`` that the newest sweep of a source saw, and those missed of which none saw anything near:
        what is seen to have gone on is not told twice. Each source sees its own side of what stands between them."""
        moving = self.moving(time) if moving is None else moving
        fresh = np.zeros_like(self._doubtful)
        for source, newest in self._newest.items():
            fresh |= moving & self._by[source] & (self.last >= newest)
        return fresh | (moving & ~dilate(fresh, _GOES_ON, beyond=False))

    def at_rest(self, time: float, moving: BoolArray | None = None) -> BoolArray:
        """(size, size) cells that hold something at rest; ``moving``: what is known to move at that time."""
        return (self.first < inf) & ~(self.moving(time) if moving is None else moving)

    def places(self, cells: BoolArray) -> FloatArray:
        """(n, 2) m; where the things in ``cells`` are."""
        return np.column_stack([self._x[cells], self._y[cells]])


def _around(i: NDArray[np.int64], j: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """(n,) how many of the points in cells (i, j) are in the same cell as each of them, or in its eight neighbours."""
    count = np.zeros((size + 2, size + 2), dtype=np.int64)
    np.add.at(count, (i + 1, j + 1), 1)
    found: NDArray[np.int64] = np.sum([count[i + right, j + up] for right in range(3) for up in range(3)], axis=0)
    return found
