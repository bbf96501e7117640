"""The surroundings of one robot, from its scans and its own way: kept from tick to tick, told for the tick's moment.

They are told as few discs that cover many places: one each where they are near, one for a block of them where they are
far. Nothing is left out: where there would still be too many, all blocks grow. So what is told errs on the safe side
only.
"""

from __future__ import annotations

from collections import deque
from functools import lru_cache
from math import floor, inf
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray
from safedpa.bus.messages.messages import ScanMessage, StateMessage
from safedpa.errors import MessageError
from safedpa.perception.obstacle_tracker import ObstacleTracker
from safedpa.perception.occupancy_grid import CELL, Grid
from safedpa.perception.odometry import OdometryBuffer, Pose
from safedpa.perception.scan import ScanRays, check_scan, hitch_position, within_body
from safedpa.perception.settings import PerceptionSettings
from safedpa.perception.source_health import Sources
from safedpa.perception.zones import (
    CONFIGURED_ZONES,
    HALF_DIAGONAL,
    ActiveZones,
    Zone,
    closed_cells,
    unoccupied_cells,
    within_any,
)

__all__ = ["SurroundingsSnapshot", "SurroundingsTracker", "closed_discs", "cover_with_fewer_discs"]

Rows = tuple[tuple[float, ...], ...]

_WAITING = 64
"""Scans that wait for the state after them."""
_AHEAD = 1.0
"""s; no state comes so late after a scan that was measured after it, or the filter believes neither."""
_LEAP = 10.0
"""s; after a leap of the clock by so much, or any backwards, nothing of before is believed."""
_STRIDE = 0.3
"""m beyond what is towed at which someone may have been seen last who went to it: two scans at 1.5 m/s."""
_NEAR = 1.5
"""m; up to here each place has a disc of its own, up to twice as far a block of 2 x 2 cells, and so on."""
_LEVELS = 2
"""Blocks of 4 x 4 cells at most, unless there is too much of it."""
_APART = 8
"""Times that blocks grow, after which those of all rings are of one size: 51 m, of which no more than four meet."""
_DEEPEST = 4
"""Of what is closed, blocks of 16 x 16 cells at most."""
_SPAN = 2**20
"""More blocks than a robot meets along a line, so that column and row make one number."""


@final
class SurroundingsSnapshot:
    """What is told of one tick; fields as in ``SurroundingsMessage``."""

    def __init__(self, points: Rows, movers: Rows, hidden: Rows) -> None:
        self.points, self.movers, self.hidden = points, movers, hidden


@final
class SurroundingsTracker:
    """Call ``hear`` for each scan as it comes, and ``at`` once for each state, ticks growing."""

    def __init__(self, settings: PerceptionSettings) -> None:
        self.settings = settings
        self.sources = Sources(settings)
        self._odometry = OdometryBuffer()
        self._waiting: deque[ScanMessage] = deque(maxlen=_WAITING)
        self._things: ObstacleTracker | None = None
        self._looked = 0.0
        """s; when the front of what hides was last drawn."""
        self._now: tuple[int, float] | None = None
        """Epoch and time [s] of the last state."""
        self._at_load = -inf
        """s; when someone went out of sight next to what is towed."""
        self._ignored: tuple[Zone, ...] = ()
        """Of the last state, as are the closed ones."""
        self._closed: tuple[Zone, ...] = ()

    def hear(self, scan: ScanMessage) -> None:
        """Keeps a scan for the next state. Raises MessageError for one that can be none."""
        check_scan(scan)
        self._waiting.append(scan)

    def at(self, state: StateMessage, in_force: ActiveZones = CONFIGURED_ZONES) -> SurroundingsSnapshot:
        """What is around the robot at the moment of ``state``, by what is ``in_force`` of sources and zones.

        Raises MessageError for a robot that is nowhere.
        """
        if len(state.values) < 3:
            raise MessageError(f"state: got {len(state.values)} values, wanted x, y, yaw first")
        x, y, yaw = state.values[:3]
        if self._now is not None and not self._goes_on(state, *self._now):
            self.sources, self._odometry, self._things = Sources(self.settings), OdometryBuffer(), None
            self._at_load = -inf
        self._now = state.epoch, state.robot_time
        self._odometry.add(state.robot_time, (x, y, yaw))
        self.sources.expect(state, in_force.off)
        speed = state.values[3] if len(state.values) > 3 else None
        self._ignored, self._closed = (in_force.of_kind(kind, speed) for kind in ("ignored", "closed"))
        if self._things is None:
            self._things, self._looked = ObstacleTracker(self.settings, x, y), state.robot_time
        self._things.follow(x, y)
        self._things.driven += self._odometry.last_step
        self._things.hiding.unoccupied = unoccupied_cells(self._ignored, self._things.grid, (x, y, yaw))
        for scan in self._due(state):
            self._take(scan, state, self._things)
        while state.robot_time - self._looked > self._things.hiding.patience:
            self._looked += self._things.hiding.patience
            self._things.hiding.wait(self._looked)
        return self._reported(state, self._things)

    def _goes_on(self, state: StateMessage, epoch: int, before: float) -> bool:
        return state.epoch == epoch and -1e-9 <= state.robot_time - before <= _LEAP

    def _due(self, state: StateMessage) -> list[ScanMessage]:
        """The scans measured by now, oldest first. Of those that wait none is kept that no later state can be of: it
        would count as new when the robot's clock comes there, however old it is by then."""
        due, later = [], []
        for scan in self._waiting:
            ahead = scan.robot_time - state.robot_time
            if ahead <= 1e-9:
                due.append(scan)
            elif scan.epoch == state.epoch and ahead > (state.period if scan.tick < state.tick else _AHEAD):
                self.sources.early(scan, ahead)
            else:
                later.append(scan)
        self._waiting = deque(later, maxlen=_WAITING)
        return sorted(due, key=lambda scan: scan.robot_time)

    def _take(self, scan: ScanMessage, state: StateMessage, things: ObstacleTracker) -> None:
        pose = self._odometry.at(scan.robot_time)
        if not self.sources.believes(scan, state) or pose is None:
            return
        sweep = ScanRays(scan, pose, state, open_air=self.settings.open_air, ignored=self._ignored)
        things.take(sweep, _own_cells(things.grid, pose, state))
        self._looked = scan.robot_time  # however late it comes: from there on the front is redrawn
        self.sources.looked(scan, sweep, things.contradicted)
        if len(state.towed) == 3 and len(state.footprint) == 3 and len(things.lost):
            apart = things.lost - hitch_position(pose, state)
            if float(np.hypot(*apart.T).min()) < state.towed[2] + _STRIDE:
                self._at_load = scan.robot_time

    def _alongside_load(self, state: StateMessage) -> Rows:
        """Where someone may be who went to what is towed: nothing of the robot's own is seen, so that he is not.

        He counts as at rest with it as late as anybody else who stops.
        """
        towing = len(state.towed) == 3 and len(state.footprint) == 3
        if not towing or state.robot_time - self._at_load > self.settings.restless:
            return ()
        x, y, yaw = state.values[:3]
        x, y = hitch_position((x, y, yaw), state).tolist()
        return ((x, y, state.towed[2]),)

    def _reported(self, state: StateMessage, things: ObstacleTracker) -> SurroundingsSnapshot:
        own, now = self.settings, state.robot_time
        x, y, yaw = state.values[:3]
        here = np.array((x, y))
        may_move = things.moving(now)
        at_rest = self._reported_of(things, things.at_rest(now, may_move))
        rest, ago = things.places(at_rest), things.driven - things.seen_at[at_rest]
        outside = ~within_body(rest, (x, y, yaw), state, 0.0)
        places, radii = rest[outside], own.point_radius + own.drift * ago[outside]
        if self._closed:
            closed = closed_discs(self._closed, x, y, own.reach)
            places, radii = np.vstack([places, closed[:, :2]]), np.append(radii, closed[:, 2])
        points = cover_with_fewer_discs(places, radii, here, own.most)
        moving = self._reported_of(things, things.moving_now(now, may_move))
        age = np.maximum(now - things.last[moving], 0.0)
        alongside = self._alongside_load(state)
        radii = own.point_radius + own.fastest * age
        movers = cover_with_fewer_discs(things.places(moving), radii, here, own.most - len(alongside))
        grid_x, grid_y = things.grid.middles
        ways_out = things.hiding.ways_out
        places = np.column_stack([grid_x[ways_out], grid_y[ways_out]])
        ahead = own.fastest * (now - self._looked)
        hidden = cover_with_fewer_discs(
            places, np.full(len(places), own.slimmest + HALF_DIAGONAL + ahead), here, own.most
        )
        return SurroundingsSnapshot(
            tuple((x, y, radius) for x, y, radius in points.tolist()),
            tuple((x, y, radius, 0.0, 0.0, own.fastest) for x, y, radius in (*movers.tolist(), *alongside)),
            tuple((x, y, radius, own.coming) for x, y, radius in hidden.tolist()),
        )

    def _reported_of(self, things: ObstacleTracker, cells: BoolArray) -> BoolArray:
        """``cells`` without those whose content lies in a zone of the map that is ignored.

        What came into a zone of the robot's own frame was seen outside of it before, and is told on.
        """
        zones = tuple(zone for zone in self._ignored if zone.frame == "map")
        if zones:
            cells = cells.copy()
            cells[cells] = ~within_any(zones, things.places(cells), (0.0, 0.0, 0.0))
        return cells


def _own_cells(grid: Grid, pose: Pose, state: StateMessage) -> BoolArray:
    """(size, size) cells whose middle lies within the robot or a cell next to it, or where what it tows may be."""
    own = np.zeros((grid.size, grid.size), dtype=bool)
    if len(state.footprint) != 3:
        return own
    rear, front, radius = state.footprint
    reach = max(abs(rear), abs(front)) + max([radius, *state.towed[2:]]) + 2.0 * CELL
    columns, rows = grid.around(pose[0], pose[1], reach)
    places = [part[columns, rows] for part in grid.middles]
    inside = within_body(np.column_stack([part.ravel() for part in places]), pose, state, CELL)
    own[columns, rows] = inside.reshape(places[0].shape)
    return own


@lru_cache(maxsize=16)
def _closed_discs(zones: tuple[Zone, ...], column: int, row: int, reach: float) -> FloatArray:
    places, depth = closed_cells(zones, column, row, reach)
    if not len(places):
        return np.empty((0, 3))
    level = np.sum([depth >= 2.0**deeper * CELL for deeper in range(1, _DEEPEST + 1)], axis=0)
    return _Blocks.of(places, level).discs(places, np.full(len(places), HALF_DIAGONAL))


def closed_discs(zones: tuple[Zone, ...], x: float, y: float, reach: float) -> FloatArray:
    """Discs (n, 3) x, y, radius [m] that cover all of the zones within ``reach`` [m] of (x, y).

    Along the border one for each cell; the deeper inside, the larger, so that none goes farther beyond the zone. They
    are the same for every place in a cell of 0.1 m, and are kept for as long as the robot is there.
    """
    return _closed_discs(zones, floor(x / CELL), floor(y / CELL), reach)


def cover_with_fewer_discs(places: FloatArray, radii: FloatArray, here: FloatArray, most: int) -> FloatArray:
    """Discs (m, 3) x, y, radius [m], m <= ``most``, that cover those of ``radii`` (n,) at ``places`` (n, 2) [m].

    The nearest to ``here`` (2,) first.
    """
    if not len(places):
        return np.empty((0, 3))
    ring = np.floor(np.hypot(*(places - here).T) / _NEAR).astype(np.int64)
    level, coarser = np.minimum(ring, _LEVELS), 0
    while len((blocks := _Blocks.of(places, level)).starts) > most:
        coarser += 1  # the far ones first
        level = np.minimum(np.maximum(ring + coarser - _LEVELS, 0), _LEVELS + coarser)
        level = np.maximum(level, np.minimum(ring, _LEVELS))
        if coarser > _APART:  # each ring would keep blocks of its own, up to four where they meet
            level = np.full_like(ring, coarser)
    found = blocks.discs(places, radii)
    order = np.argsort(np.hypot(found[:, 0] - here[0], found[:, 1] - here[1]) - found[:, 2])
    return found[order]


class _Blocks(NamedTuple):
    """Which places are in the same block of 2^level x 2^level cells, and of the same level."""

    order: NDArray[np.int64]
    """Of the places, block after block."""
    starts: NDArray[np.int64]
    """Where in that order each block begins."""

    @classmethod
    def of(cls, places: FloatArray, level: NDArray[np.int64]) -> _Blocks:
        edge = CELL * 2.0**level
        column, row = (np.floor(places[:, axis] / edge).astype(np.int64) for axis in (0, 1))
        key = (level * _SPAN + column % _SPAN) * _SPAN + row % _SPAN
        order = np.argsort(key)
        sorted_keys = key[order]
        begins = np.empty(len(key), dtype=bool)
        begins[0], begins[1:] = True, sorted_keys[1:] != sorted_keys[:-1]
        return cls(order, np.flatnonzero(begins))

    def discs(self, places: FloatArray, radii: FloatArray) -> FloatArray:
        """One disc (blocks, 3) x, y, radius [m] for all places in each."""
        there = places[self.order]
        low, high = np.minimum.reduceat(there, self.starts), np.maximum.reduceat(there, self.starts)
        found = np.empty((len(self.starts), 3))
        found[:, :2] = 0.5 * (low + high)
        found[:, 2] = np.maximum.reduceat(radii[self.order], self.starts) + 0.5 * np.hypot(*(high - low).T)
        return found
