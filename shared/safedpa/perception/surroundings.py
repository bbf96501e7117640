"""Computes the surroundings of one robot from its scans and odometry, at the time of each state.

They are published as a limited number of discs: one for each near cell, one for a block of far cells. If there are too
many, the blocks grow; nothing is omitted, so the result is always conservative.
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
from safedpa.perception.obstacle_tracker import ObstacleTracker
from safedpa.perception.occupancy_grid import CELL, Grid
from safedpa.perception.odometry import OdometryBuffer, Pose, pose_of, speed_of
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

_MAX_WAITING = 64
"""Largest number of scans that wait for their state."""
_MAX_AHEAD = 1.0
"""s; a scan that is further ahead of the state has a wrong clock: a state so late is refused by the filter anyway."""
_CLOCK_JUMP = 10.0
"""s; if the clock jumps by so much, or backwards at all, the whole memory is cleared."""
_STEP_TO_TRAILER = 0.3
"""m from the trailer within which a mover may have gone to it in two scans at 1.5 m/s, besides the time unseen."""
_RING_WIDTH = 1.5
"""m; nearer cells have a disc each; up to twice this distance a disc covers 2 x 2 cells, and so on."""
_MAX_LEVEL = 2
"""Blocks have at most 4 x 4 cells, unless there are too many discs."""
_MAX_COARSER = 8
"""After so many doublings all rings use one block size (51 m), of which at most four meet."""
_MAX_CLOSED_LEVEL = 4
"""Blocks of closed cells have at most 16 x 16 cells."""
_SPAN = 2**20
"""More than the number of blocks along a line, so that column and row can be combined in one integer."""


@final
class SurroundingsSnapshot:
    """Surroundings at one tick; fields as in ``SurroundingsMessage``."""

    def __init__(self, points: Rows, movers: Rows, hidden: Rows) -> None:
        self.points, self.movers, self.hidden = points, movers, hidden


@final
class SurroundingsTracker:
    """Tracks the surroundings: call ``hear`` for each scan and ``at`` once for each state, in the order of ticks."""

    def __init__(self, settings: PerceptionSettings) -> None:
        self.settings = settings
        self.sources = Sources(settings)
        self._odometry = OdometryBuffer()
        self._waiting: deque[ScanMessage] = deque(maxlen=_MAX_WAITING)
        self._tracker: ObstacleTracker | None = None
        self._front_time = 0.0
        """Time of the last update of the occlusion front, s."""
        self._now: tuple[int, float] | None = None
        """Epoch and time [s] of the last state."""
        self._lost_at_trailer = -inf
        """Time when a mover went out of sight next to the trailer, s."""
        self._ignored: tuple[Zone, ...] = ()
        """Active ignored and closed zones at the last state."""
        self._closed: tuple[Zone, ...] = ()

    def hear(self, scan: ScanMessage) -> None:
        """Stores a scan for the next state; raises MessageError for an invalid one."""
        check_scan(scan)
        self._waiting.append(scan)

    def at(self, state: StateMessage, active: ActiveZones = CONFIGURED_ZONES) -> SurroundingsSnapshot:
        """Returns the surroundings at the time of ``state``, with the ``active`` sources and zones.

        Raises MessageError for a state without a pose.
        """
        x, y, yaw = pose_of(state)
        if self._now is not None and not self._continues(state, *self._now):
            self.sources, self._odometry, self._tracker = Sources(self.settings), OdometryBuffer(), None
            self._lost_at_trailer = -inf
        self._now = state.epoch, state.robot_time
        self._odometry.add(state.robot_time, (x, y, yaw))
        self.sources.expect(state, active.off)
        speed = speed_of(state)
        self._ignored, self._closed = (active.of_kind(kind, speed) for kind in ("ignored", "closed"))
        if self._tracker is None:
            self._tracker, self._front_time = ObstacleTracker(self.settings, x, y), state.robot_time
        self._tracker.follow(x, y)
        self._tracker.driven += self._odometry.last_step
        self._tracker.hiding.unoccupied = unoccupied_cells(self._ignored, self._tracker.grid, (x, y, yaw))
        for scan in self._due_scans(state):
            self._process(scan, state, self._tracker)
        while state.robot_time - self._front_time > self._tracker.hiding.patience:
            self._front_time += self._tracker.hiding.patience
            self._tracker.hiding.wait(self._front_time)
        return self._snapshot(state, self._tracker)

    def _continues(self, state: StateMessage, epoch: int, before: float) -> bool:
        return state.epoch == epoch and -1e-9 <= state.robot_time - before <= _CLOCK_JUMP

    def _due_scans(self, state: StateMessage) -> list[ScanMessage]:
        """The scans measured by now, oldest first. Of those that wait none is kept that no later state can be of: it
        would count as new when the robot's clock comes sorted_places, however old it is by then."""
        due, later = [], []
        for scan in self._waiting:
            ahead = scan.robot_time - state.robot_time
            if ahead <= 1e-9:
                due.append(scan)
            elif scan.epoch == state.epoch and ahead > (state.period if scan.tick < state.tick else _MAX_AHEAD):
                self.sources.note_early(scan, ahead)
            else:
                later.append(scan)
        self._waiting = deque(later, maxlen=_MAX_WAITING)
        return sorted(due, key=lambda scan: scan.robot_time)

    def _process(self, scan: ScanMessage, state: StateMessage, tracker: ObstacleTracker) -> None:
        pose = self._odometry.at(scan.robot_time)
        if not self.sources.accepts(scan, state) or pose is None:
            return
        sweep = ScanRays(scan, pose, state, open_air=self.settings.open_air, ignored=self._ignored)
        tracker.take(sweep, _own_cells(tracker.grid, pose, state))
        self._front_time = scan.robot_time  # also for a late scan: the front is advanced again from there
        # A cone has one reading for all its rays, and most of its arc is empty: it contradicts nothing.
        cone = min(scan.ranges) == max(scan.ranges)
        self.sources.processed(scan, sweep, 0.0 if cone else tracker.contradicted)
        if len(state.towed) == 3 and len(state.footprint) == 3 and len(tracker.lost):
            apart = tracker.lost - hitch_position(pose, state)
            room = np.hypot(*apart.T) - self.settings.fastest * tracker.unseen_for
            if float(room.min()) < state.towed[2] + _STEP_TO_TRAILER:
                self._lost_at_trailer = scan.robot_time

    def _movers_at_trailer(self, state: StateMessage) -> Rows:
        """A mover at the trailer, if one was lost next to it: points on the robot and its trailer are filtered out.

        It counts as a mover for as long as any other that stops (``restless``).
        """
        towing = len(state.towed) == 3 and len(state.footprint) == 3
        if not towing or state.robot_time - self._lost_at_trailer > self.settings.restless:
            return ()
        x, y, yaw = pose_of(state)
        x, y = hitch_position((x, y, yaw), state).tolist()
        return ((x, y, state.towed[2]),)

    def _snapshot(self, state: StateMessage, tracker: ObstacleTracker) -> SurroundingsSnapshot:
        own, now = self.settings, state.robot_time
        x, y, yaw = pose_of(state)
        here = np.array((x, y))
        may_move = tracker.moving(now)
        at_rest = self._outside_ignored(tracker, tracker.at_rest(now, may_move))
        rest, ago = tracker.places(at_rest), tracker.driven - tracker.seen_at[at_rest]
        outside = ~within_body(rest, (x, y, yaw), state, 0.0)
        places, radii = rest[outside], own.point_radius + own.drift * ago[outside]
        if self._closed:
            closed = closed_discs(self._closed, x, y, own.reach)
            places, radii = np.vstack([places, closed[:, :2]]), np.append(radii, closed[:, 2])
        points = cover_with_fewer_discs(places, radii, here, own.most)
        moving = self._outside_ignored(tracker, tracker.moving_now(now, may_move))
        age = np.maximum(now - tracker.last[moving], 0.0)
        at_trailer = self._movers_at_trailer(state)
        radii = own.point_radius + own.fastest * age
        movers = cover_with_fewer_discs(tracker.places(moving), radii, here, own.most - len(at_trailer))
        grid_x, grid_y = tracker.grid.middles
        exits = tracker.hiding.exits
        places = np.column_stack([grid_x[exits], grid_y[exits]])
        ahead = own.fastest * (now - self._front_time)
        hidden = cover_with_fewer_discs(
            places, np.full(len(places), own.slimmest + HALF_DIAGONAL + ahead), here, own.most
        )
        return SurroundingsSnapshot(
            tuple((x, y, radius) for x, y, radius in points.tolist()),
            tuple((x, y, radius, 0.0, 0.0, own.fastest) for x, y, radius in (*movers.tolist(), *at_trailer)),
            tuple((x, y, radius, own.coming) for x, y, radius in hidden.tolist()),
        )

    def _outside_ignored(self, tracker: ObstacleTracker, cells: BoolArray) -> BoolArray:
        """Removes cells whose content lies in an ignored zone in the frame of the map.

        An object that enters an ignored zone in the frame of the robot was seen outside before, and stays reported.
        """
        zones = tuple(zone for zone in self._ignored if zone.frame == "map")
        if zones:
            cells = cells.copy()
            cells[cells] = ~within_any(zones, tracker.places(cells), (0.0, 0.0, 0.0))
        return cells


def _own_cells(grid: Grid, pose: Pose, state: StateMessage) -> BoolArray:
    """Cells (size, size) of the robot and its trailer, enlarged by one cell."""
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
    level = np.sum([depth >= 2.0**deeper * CELL for deeper in range(1, _MAX_CLOSED_LEVEL + 1)], axis=0)
    return _Blocks.of(places, level).discs(places, np.full(len(places), HALF_DIAGONAL))


def closed_discs(zones: tuple[Zone, ...], x: float, y: float, reach: float) -> FloatArray:
    """Discs (n, 3) x, y, radius [m] that cover the closed zones within ``reach`` [m] of (x, y).

    Cells at the border have a disc each; deeper inside the discs are larger, but do not extend further beyond the zone.
    The result is the same for all positions in a cell of 0.1 m, and is cached while the robot is there.
    """
    return _closed_discs(zones, floor(x / CELL), floor(y / CELL), reach)


def cover_with_fewer_discs(places: FloatArray, radii: FloatArray, here: FloatArray, most: int) -> FloatArray:
    """Covers discs of ``radii`` (n,) at ``places`` (n, 2) [m] by at most ``most`` discs (m, 3) x, y, radius [m].

    The result is sorted by distance from ``here`` (2,).
    """
    if not len(places):
        return np.empty((0, 3))
    ring = np.floor(np.hypot(*(places - here).T) / _RING_WIDTH).astype(np.int64)
    level, coarser = np.minimum(ring, _MAX_LEVEL), 0
    while len((blocks := _Blocks.of(places, level)).starts) > most:
        coarser += 1  # far blocks grow first
        level = np.minimum(np.maximum(ring + coarser - _MAX_LEVEL, 0), _MAX_LEVEL + coarser)
        level = np.maximum(level, np.minimum(ring, _MAX_LEVEL))
        if coarser > _MAX_COARSER:  # one size for all: rings with their own blocks would keep too many where they meet
            level = np.full_like(ring, coarser)
    found = blocks.discs(places, radii)
    order = np.argsort(np.hypot(found[:, 0] - here[0], found[:, 1] - here[1]) - found[:, 2])
    return found[order]


class _Blocks(NamedTuple):
    """Groups places by blocks of 2^level x 2^level cells."""

    order: NDArray[np.int64]
    """Indices of the places, sorted by block."""
    starts: NDArray[np.int64]
    """Start of each block in ``order``."""

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
        """One disc for each block, (blocks, 3) x, y, radius [m], that covers the discs of its places."""
        sorted_places = places[self.order]
        low, high = np.minimum.reduceat(sorted_places, self.starts), np.maximum.reduceat(sorted_places, self.starts)
        found = np.empty((len(self.starts), 3))
        found[:, :2] = 0.5 * (low + high)
        found[:, 2] = np.maximum.reduceat(radii[self.order], self.starts) + 0.5 * np.hypot(*(high - low).T)
        return found
