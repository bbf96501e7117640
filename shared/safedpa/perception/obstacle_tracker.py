"""Tracks what was seen around the robot on a grid: cells at rest, cells that may move, and empty cells.

Rules for a cell that is hit for the first time:

- It is at rest if no mover can have reached it (``hiding``), if it is next to a long-known obstacle (noise), or if it
  was never seen empty and is next to an obstacle at rest (more of the same object comes into view).
- It may move if something hidden may have reached it, until it has stayed for ``still_after``.
- If it was seen empty before, its content has moved: it may move until it has stayed for ``restless``.

A cell that is seen through is empty. A mover that is not seen again is removed too: it is either seen elsewhere or
hidden (``leaves``).
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


_RAY_WIDTH = 0.06
"""m; a cell counts as seen through if all rays within this distance of its middle pass."""
_NEIGHBOURHOOD = 1.5 * CELL
"""m; noise displaces a point by up to so much."""
_GRID_SLACK = 8
"""Cells by which the robot may leave the middle of the grid before the grid follows."""
_SOLID_AFTER = 0.5
"""s at rest after which an obstacle is solid: nothing hides in it, and new points next to it are noise."""
_LOST_AFTER = 0.25
"""s after which an unseen mover has left its cell: two scans at 10 Hz missed it."""
_STEP_BETWEEN_SCANS = 0.3
"""m; largest shift of a hit between scans: 1.5 m/s at 10 Hz, plus another point on the body."""
_POINT_WEIGHT = 0.3
"""Weight of a new point in the mean of a cell."""


@final
class ObstacleTracker:
    """Contents of the cells, in the frame of the robot's position."""

    def __init__(self, settings: PerceptionSettings, x: float, y: float) -> None:
        self.settings = settings
        self.grid = Grid(settings.reach, x, y)
        size = self.grid.size
        self.hiding = OcclusionMap(size, settings.slimmest, settings.fastest)
        self.first: FloatArray = np.full((size, size), inf)
        """Time when the content of a cell was first seen, s; infinity if it is empty."""
        self.last: FloatArray = np.full((size, size), -inf)
        """Time when it was last seen, s."""
        self.driven = 0.0
        """Distance driven so far, m."""
        self.seen_at: FloatArray = np.zeros((size, size))
        """Value of ``driven`` when the content of a cell was last seen, m."""
        self._moved: FloatArray = np.full((size, size), -inf)
        """Time when the content was last seen to move, s."""
        self._maybe_hidden: BoolArray = np.zeros((size, size), dtype=bool)
        """Whether the content may have come out of a hidden region."""
        self._by: dict[str, BoolArray] = {}
        """Cells that a source has hit and not seen through since, by source."""
        self._emptied: dict[str, BoolArray] = {}
        """Cells that a source has ever seen empty, by source."""
        self._x, self._y = (middles.copy() for middles in self.grid.middles)
        self.contradicted = 0.0
        """Share of the cells hit by the last scan whose content may move; 0 until obstacles at rest are known."""
        self.lost: FloatArray = np.empty((0, 2))
        """Positions (n, 2) [m] where the last scan lost a mover, with none seen nearby: it went out of sight."""
        self.unseen_for: FloatArray = np.empty(0)
        """Time (n,) [s] between the last scan that saw each of them and the one that lost it."""
        self._first_scan: float | None = None
        self._newest: dict[str, float] = {}
        """Time of the newest scan of each source, s."""

    def follow(self, x: float, y: float) -> None:
        """Moves the grid with the robot."""
        shift = self.grid.shift_to(x, y, _GRID_SLACK)
        if shift == (0, 0):
            return
        self.grid.move(shift)
        self.hiding.move(shift)
        self.first, self.last = shift_cells(self.first, shift, inf), shift_cells(self.last, shift, -inf)
        self._moved, self.seen_at = shift_cells(self._moved, shift, -inf), shift_cells(self.seen_at, shift, 0.0)
        for flags in (self._by, self._emptied):
            flags.update({source: shift_cells(cells, shift, False) for source, cells in flags.items()})
        self._maybe_hidden = shift_cells(self._maybe_hidden, shift, False)
        middles = self.grid.middles
        self._x, self._y = shift_cells(self._x, shift, 0.0), shift_cells(self._y, shift, 0.0)
        empty = self.first == inf
        self._x[empty], self._y[empty] = middles[0][empty], middles[1][empty]

    def take(self, sweep: ScanRays, own: BoolArray) -> None:
        """Processes one scan; ``own`` (size, size) marks the cells of the robot itself."""
        time = sweep.time
        moved_before, last_before = self.moving(time), self.last.copy()
        middles = self.grid.middles
        distance, sight = sweep.sight(*middles, _RAY_WIDTH)
        i, j, within = self.grid.cells(sweep.ends)
        i, j, ends = i[within], j[within], sweep.ends[within]
        least = self.settings.min_points_of(sweep.source)
        if least > 1:
            enough = _points_nearby(i, j, self.grid.size) >= least
            i, j, ends = i[enough], j[enough], ends[enough]
        hit = np.zeros_like(own)
        hit[i, j] = True
        seen = (distance < sight - BEHIND) & ~hit
        empty = seen & ~dilate(
            hit, _NEIGHBOURHOOD, beyond=False
        )  # a ray along a wall passes close to its cells without showing that they are empty
        self._forget(empty, sweep)
        self._add(hit, sweep)
        self._place(i, j, ends)
        moving = self.moving(time)
        self._first_scan = time if self._first_scan is None else self._first_scan
        self._newest[sweep.source] = max(self._newest.get(sweep.source, -inf), time)
        knows = time > self._first_scan + 2.0 * _SOLID_AFTER
        self.contradicted = float((hit & moving).sum() / max(hit.sum(), 1)) if knows else 0.0
        past = sweep.farthest_past(*middles, self.hiding.width)
        looked_through = (distance < past - BEHIND) & ~hit
        looked_through |= dilate(hit & moving, CELL, beyond=False) & (distance < sight)
        self.hiding.look(time, looked_through, self._solid(time, self.at_rest(time, moving)), own, moving)
        self._emptied[sweep.source] |= empty
        unseen = moving & (self.last < time - _LOST_AFTER)
        self._clear(unseen)
        cleared = moved_before & (self.first == inf)  # not seen for long, or a ray passes through
        gone = cleared & ~dilate(moving & ~unseen, _STEP_BETWEEN_SCANS, beyond=False)
        self.lost, self.unseen_for = self.places(gone), np.maximum(time - last_before[gone], 0.0)

    def _solid(self, time: float, at_rest: BoolArray) -> BoolArray:
        return at_rest & (self.first <= time - _SOLID_AFTER)

    def _forget(self, empty: BoolArray, sweep: ScanRays) -> None:
        """Clears cells that every source which hit them now sees through: one source may look over a low obstacle."""
        time, none = sweep.time, np.zeros_like(empty)
        for flags in (self._by, self._emptied):
            flags.setdefault(sweep.source, none.copy())
        seen_through = empty & (self.last <= time)
        self._by[sweep.source][seen_through] = False
        still_hit = np.logical_or.reduce(list(self._by.values()))
        self._clear((seen_through & ~still_hit) | (self.last < time - self.settings.memory))

    def _clear(self, cleared: BoolArray) -> None:
        self.first[cleared], self.last[cleared], self._moved[cleared] = inf, -inf, -inf
        self._maybe_hidden[cleared] = False
        for cells in self._by.values():
            cells[cleared] = False

    def _add(self, hit: BoolArray, sweep: ScanRays) -> None:
        """Classifies each cell that is hit for the first time."""
        own, time, emptied = self.settings, sweep.time, self._emptied[sweep.source]
        new = hit & (self.first == inf)
        at_rest = self.at_rest(time, self.moving(time))
        near_solid = dilate(self._solid(time, at_rest), _NEIGHBOURHOOD, beyond=False)
        near_solid |= dilate(at_rest, _NEIGHBOURHOOD, beyond=False) & ~emptied
        appeared = new & ~near_solid & emptied
        came = new & ~near_solid & ~appeared & dilate(self.hiding.reached(time), own.widest, beyond=True)
        restless = dilate(self._moved > time - own.restless, _NEIGHBOURHOOD, beyond=False)
        self._moved[appeared | (new & ~near_solid & restless)] = time
        self._maybe_hidden[came] = True
        self.first[new] = time
        self.last[hit] = np.maximum(self.last[hit], time)
        self.seen_at[hit] = self.driven
        self._by[sweep.source] |= hit

    def _place(self, i: NDArray[np.int64], j: NDArray[np.int64], ends: FloatArray) -> None:
        """Updates the mean point of each cell; a cell that was empty gets the mean of its points."""
        flat = i * self.grid.size + j
        cells, where = np.unique(flat, return_inverse=True)
        count = np.bincount(where)
        for mean, column in ((self._x, ends[:, 0]), (self._y, ends[:, 1])):
            fresh = np.bincount(where, weights=column) / count
            known = mean.ravel()[cells]
            started = self.first.ravel()[cells] >= self.last.ravel()[cells]
            mean.ravel()[cells] = np.where(started, fresh, known + _POINT_WEIGHT * (fresh - known))

    def moving(self, time: float) -> BoolArray:
        """Cells (size, size) whose content may move."""
        own = self.settings
        doubtful = self._maybe_hidden & (self.last - self.first < own.still_after)
        return (self.first < inf) & (doubtful | (self._moved > time - own.restless))

    def moving_now(self, time: float, moving: BoolArray | None = None) -> BoolArray:
        """Cells of ``moving`` that the newest scan of some source saw, and unseen ones without a seen mover nearby.

        So a mover that has left its cell is not reported twice. Every source counts, because each sees its own side.
        """
        moving = self.moving(time) if moving is None else moving
        fresh = np.zeros_like(self._maybe_hidden)
        for source, newest in self._newest.items():
            fresh |= moving & self._by[source] & (self.last >= newest)
        return fresh | (moving & ~dilate(fresh, _STEP_BETWEEN_SCANS, beyond=False))

    def at_rest(self, time: float, moving: BoolArray | None = None) -> BoolArray:
        """Cells (size, size) whose content is at rest; ``moving`` is ``self.moving(time)`` if known."""
        return (self.first < inf) & ~(self.moving(time) if moving is None else moving)

    def places(self, cells: BoolArray) -> FloatArray:
        """Mean measured positions (n, 2) [m] in the flagged cells."""
        return np.column_stack([self._x[cells], self._y[cells]])


def _points_nearby(i: NDArray[np.int64], j: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """For each point in cells (i, j), how many points are in its cell or the eight neighbours; shape (n,)."""
    count = np.zeros((size + 2, size + 2), dtype=np.int64)
    np.add.at(count, (i + 1, j + 1), 1)
    found: NDArray[np.int64] = np.sum([count[i + right, j + up] for right in range(3) for up in range(3)], axis=0)
    return found
