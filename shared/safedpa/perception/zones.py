"""Places that a person marks: where nothing that is seen is told (``ignored``), and where no one drives (``closed``).

A place is a polygon, or the occupied cells of a map.

What a robot drives with is its file's, changed by orders: ``ActiveZones``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from math import ceil, cos, isfinite, sin
from typing import final

import numpy as np

from safedpa.arrays import BoolArray, FloatArray, IndexArray
from safedpa.errors import InputError, did_you_mean
from safedpa.perception.occupancy_grid import CELL, Grid, dilate
from safedpa.perception.odometry import Pose
from safedpa.perception.ros_map import PackedCells

__all__ = [
    "CONFIGURED_ZONES",
    "HALF_DIAGONAL",
    "ActiveZones",
    "Zone",
    "closed_cells",
    "distance_to_border",
    "polygon_contains",
    "unoccupied_cells",
    "within_any",
    "zone_entry_distance",
]

Corners = tuple[tuple[float, float], ...]

KINDS, FRAMES = ("ignored", "closed"), ("map", "robot")
_FEWEST, _MOST = 3, 64
"""Vertices of a polygon."""
_MOST_REPORTED = 512
"""Vertices of all zones that are told for pictures: 14 KB in each message."""
_FARTHEST = 1e5
"""m; as far from its frame's origin may a vertex be."""
_SMALLEST = 1e-6
"""m2; of less the vertices are one place, or in one line but for the last digits."""
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,60}")
"""An order names zones as NAME=on."""
HALF_DIAGONAL = CELL / 2**0.5
"""m from a cell's middle to its corners."""


@final
@dataclass(frozen=True)
class Zone:
    """A place of ``kind`` in the ``frame`` of the states' positions (``map``) or of the robot's body (``robot``).

    It is a polygon, or, of a closed one in the frame of the map, ``cells``.

    Raises InputError naming the zone and what is wrong with it.
    """

    name: str
    kind: str
    polygon: Corners
    """(3 to 64, 2) m; vertices in order, either way round, of edges that do not cross. None of a map's cells."""
    frame: str = "map"
    speed: tuple[float, float] | None = None
    """m/s, lowest and highest |speed| of the robot at which it counts; None: at any."""
    robots: tuple[str, ...] = ()
    """For which it counts; empty: for all."""
    use: bool = True
    """Whether it counts unless an order says otherwise."""
    cells: PackedCells | None = None

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise InputError(f"zone name: got {self.name!r}, wanted 1 to 60 letters, digits, '_', '-' or '.'")
        for what, value, known in (("kind", self.kind, KINDS), ("frame", self.frame, FRAMES)):
            if value not in known:
                raise InputError(f"zone {self.name}: {what}: got {value!r}; {did_you_mean(str(value), known)}")
        if (self.kind, self.frame) == ("closed", "robot"):
            raise InputError(
                f"zone {self.name}: got a closed zone in the frame of the robot, which it would never get out of; "
                'wanted frame = "map"'
            )
        if self.cells is None:
            self._check_polygon()
        elif self.polygon or (self.kind, self.frame) != ("closed", "map"):
            raise InputError(
                f"zone {self.name}: got cells of a map for {self.kind} in the frame of the {self.frame}"
                f"{' next to a polygon' if self.polygon else ''}; wanted closed, frame = map, and cells alone"
            )
        low, high = (0.0, 0.0) if self.speed is None else self.speed
        if not (isfinite(low) and isfinite(high) and 0.0 <= low <= high):
            raise InputError(f"zone {self.name}: speed: got {low:g} to {high:g} m/s, wanted 0 or more, the lower first")

    def _check_polygon(self) -> None:
        count = len(self.polygon)
        if not _FEWEST <= count <= _MOST:
            raise InputError(f"zone {self.name}: polygon: got {count} vertices, wanted {_FEWEST} to {_MOST}")
        corners = np.array(self.polygon)
        if not np.all(np.isfinite(corners)) or np.abs(corners).max() > _FARTHEST:
            raise InputError(f"zone {self.name}: polygon: got a vertex beyond {_FARTHEST:g} m, wanted metres")
        twice = [corner for index, corner in enumerate(self.polygon) if corner in self.polygon[:index]]
        if twice:
            raise InputError(f"zone {self.name}: polygon: got the vertex {list(twice[0])} twice, wanted each once")
        crossed = _crossing(corners)
        if crossed:
            first, second = crossed
            raise InputError(
                f"zone {self.name}: polygon: edge {first + 1} meets edge {second + 1}; wanted the vertices in order "
                "around it"
            )
        if _area(corners) < _SMALLEST:
            raise InputError(f"zone {self.name}: polygon: got no area, wanted vertices that are not in one line")

    def counts_for(self, robot: str) -> bool:
        """Whether it is one of this robot's."""
        return not self.robots or robot in self.robots

    def counts_at(self, speed: float | None) -> bool:
        """Whether it counts at a speed [m/s]; None: it is not known, and only what closes counts then."""
        if self.speed is None:
            return True
        if speed is None or not isfinite(speed):
            return self.kind == "closed"
        return self.speed[0] <= abs(speed) <= self.speed[1]

    def corners(self, pose: Pose) -> FloatArray:
        """(vertices, 2) m in the frame of the states' positions, of a robot at ``pose``."""
        corners = np.array(self.polygon)
        if self.frame == "map":
            return corners
        x, y, yaw = pose
        ahead, aside = corners.T
        return np.column_stack([x + ahead * cos(yaw) - aside * sin(yaw), y + ahead * sin(yaw) + aside * cos(yaw)])


@final
@dataclass(frozen=True)
class ActiveZones:
    """What counts for one robot now."""

    off: frozenset[str] = frozenset()
    """Names of its sources that are not listened to."""
    zones: tuple[Zone, ...] = ()
    ordered: str = ""
    """What differs from the file by orders, and who gave the last one; empty: nothing does."""

    @property
    def names(self) -> tuple[str, ...]:
        """Kind and name of each zone."""
        return tuple(f"{zone.kind} {zone.name}" for zone in self.zones)

    def borders(self, pose: Pose) -> tuple[tuple[float, float, float], ...]:
        """(vertices, 3): which of the zones, x and y [m], for a robot at ``pose``; of the first zones that have
        _MOST_TOLD vertices together."""
        rows: list[tuple[float, float, float]] = []
        for number, zone in enumerate(self.zones):
            if zone.cells is not None:
                continue
            if len(rows) + len(zone.polygon) > _MOST_REPORTED:
                break
            rows += [(float(number), x, y) for x, y in zone.corners(pose).tolist()]
        return tuple(rows)

    def at(self, speed: float | None) -> ActiveZones:
        """With the zones alone that count at a speed [m/s]."""
        return replace(self, zones=tuple(zone for zone in self.zones if zone.counts_at(speed)))

    def of_kind(self, kind: str, speed: float | None) -> tuple[Zone, ...]:
        """Its zones of a kind at a speed [m/s]."""
        return tuple(zone for zone in self.zones if zone.kind == kind and zone.counts_at(speed))


CONFIGURED_ZONES = ActiveZones()


def _edges(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    return corners, np.roll(corners, -1, axis=0)


def _area(corners: FloatArray) -> float:
    start, end = _edges(corners)
    return float(abs(np.sum(start[:, 0] * end[:, 1] - end[:, 0] * start[:, 1])) / 2.0)


def _turn(one: FloatArray, other: FloatArray, third: FloatArray) -> float:
    """Above 0 where ``third`` lies to the left of the way from ``one`` to ``other``."""
    way, apart = other - one, third - one
    return float(way[0] * apart[1] - way[1] * apart[0])


def _crossing(corners: FloatArray) -> tuple[int, int] | None:
    """Two edges that have a point in common but for the vertex between neighbours; None: there are none."""
    start, end = _edges(corners)
    count = len(corners)
    for i in range(count):
        for j in range(i + 1, count):
            neighbours = j == i + 1 or (i == 0 and j == count - 1)
            if _folded(start, end, i, j, count) if neighbours else _meet(start[i], end[i], start[j], end[j]):
                return i, j
    return None


def _folded(start: FloatArray, end: FloatArray, i: int, j: int, count: int) -> bool:
    """Whether the later of two neighbours goes back on the former one."""
    first, second = (i, j) if j == i + 1 else (j, i)
    if count == 3:
        return False  # its area says so
    before, after = start[first] - end[first], end[second] - start[second]
    return bool(_turn(end[first], start[first], end[second]) == 0.0 and before @ after > 0.0)


def _meet(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> bool:
    sides = _turn(a, b, c), _turn(a, b, d), _turn(c, d, a), _turn(c, d, b)
    if sides[0] * sides[1] < 0.0 and sides[2] * sides[3] < 0.0:
        return True
    rows = ((sides[0], a, b, c), (sides[1], a, b, d), (sides[2], c, d, a), (sides[3], c, d, b))
    return any(side == 0.0 and _between(one, other, point) for side, one, other, point in rows)


def _between(one: FloatArray, other: FloatArray, point: FloatArray) -> bool:
    low, high = np.minimum(one, other), np.maximum(one, other)
    return bool(np.all(low <= point) and np.all(point <= high))


def polygon_contains(corners: FloatArray, places: FloatArray) -> BoolArray:
    """Which of ``places`` (n, 2) lie within the polygon (vertices, 2): a line to the right meets its border oddly."""
    within = np.zeros(len(places), dtype=bool)
    x, y = places.T.copy()
    for (from_x, from_y), (to_x, to_y) in zip(*(part.tolist() for part in _edges(corners)), strict=True):
        passes = np.flatnonzero((from_y > y) != (to_y > y))
        if len(passes):
            share = (y[passes] - from_y) / (to_y - from_y)
            within[passes] ^= x[passes] < from_x + share * (to_x - from_x)
    return within


def distance_to_border(corners: FloatArray, places: FloatArray) -> FloatArray:
    """m (n,) from ``places`` (n, 2) to the nearest edge."""
    nearest = np.full(len(places), np.inf)
    x, y = places.T.copy()
    for (from_x, from_y), (to_x, to_y) in zip(*(part.tolist() for part in _edges(corners)), strict=True):
        way_x, way_y, apart_x, apart_y = to_x - from_x, to_y - from_y, x - from_x, y - from_y
        along = np.clip((apart_x * way_x + apart_y * way_y) / (way_x**2 + way_y**2), 0.0, 1.0)
        np.minimum(nearest, (apart_x - along * way_x) ** 2 + (apart_y - along * way_y) ** 2, out=nearest)
    distance: FloatArray = np.sqrt(nearest)
    return distance


def _cells(corners: FloatArray, margin: float, lowest: IndexArray, highest: IndexArray) -> IndexArray:
    """(n, 2) column and row of all cells, between the two given ones, of the box around the polygon and ``margin``
    [m]."""
    low = np.maximum(np.floor((corners.min(axis=0) - margin) / CELL).astype(np.int64), lowest)
    high = np.minimum(np.floor((corners.max(axis=0) + margin) / CELL).astype(np.int64), highest)
    ranges = [np.arange(first, last + 1) for first, last in zip(low.tolist(), high.tolist(), strict=True)]
    return np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, 2)


def _middles(cells: IndexArray) -> FloatArray:
    """(n, 2) m"""
    return np.asarray((cells + 0.5) * CELL, dtype=np.float64)


def within_any(zones: tuple[Zone, ...], places: FloatArray, pose: Pose) -> BoolArray:
    """Which of ``places`` (n, 2) m lie in one of the zones of a robot at ``pose``."""
    found = np.zeros(len(places), dtype=bool)
    for zone in zones:
        found |= polygon_contains(zone.corners(pose), places)
    return found


def zone_entry_distance(
    zones: tuple[Zone, ...], pose: Pose, sensor: tuple[float, float], ends: FloatArray
) -> FloatArray:
    """m (n,) from the ``sensor`` at which rays to ``ends`` (n, 2) m first come into a zone in which they end.

    Infinity for those that end in none; 0 where the sensor itself is in it.
    """
    found = np.full(len(ends), np.inf)
    here = np.array(sensor)
    for zone in zones:
        corners = zone.corners(pose)
        there = polygon_contains(corners, ends)
        if there.any():
            first = 0.0 if polygon_contains(corners, here[np.newaxis])[0] else _first_edge(corners, here, ends[there])
            found[there] = np.minimum(found[there], first)
    return found


def _first_edge(corners: FloatArray, here: FloatArray, ends: FloatArray) -> FloatArray:
    """m (n,) from ``here`` to the first edge on the way to each of ``ends`` (n, 2); 0 where none is met."""
    way = ends - here
    share = np.full(len(ends), np.inf)
    for start, end in zip(*_edges(corners), strict=True):
        edge, apart = end - start, start - here
        with np.errstate(divide="ignore", invalid="ignore"):
            across = way[:, 0] * edge[1] - way[:, 1] * edge[0]
            on_way = (apart[0] * edge[1] - apart[1] * edge[0]) / across
            on_edge = (apart[0] * way[:, 1] - apart[1] * way[:, 0]) / across
        met = (on_way >= 0.0) & (on_edge >= -1e-9) & (on_edge <= 1.0 + 1e-9)
        np.minimum(share, np.where(met, on_way, np.inf), out=share)
    first: FloatArray = np.where(share <= 1.0, share, 0.0) * np.hypot(*way.T)
    return first


def unoccupied_cells(zones: tuple[Zone, ...], grid: Grid, pose: Pose) -> BoolArray:
    """(size, size) cells in which no one is taken to hide: of the zones, and next to them as far as he would overlap."""
    found = np.zeros((grid.size, grid.size), dtype=bool)
    if not zones:
        return found
    lowest = np.array((grid.left, grid.low))
    for zone in zones:
        corners = zone.corners(pose)
        cells = _cells(corners, 0.0, lowest, lowest + grid.size - 1)
        middles = _middles(cells)
        taken = cells[polygon_contains(corners, middles)] - lowest
        found[taken[:, 0], taken[:, 1]] = True
    return dilate(found, CELL, beyond=False)


def closed_cells(zones: tuple[Zone, ...], column: int, row: int, reach: float) -> tuple[FloatArray, FloatArray]:
    """Middles (n, 2) m of all cells that the zones have any part of within ``reach`` [m] of any place in one cell.

    And their depth (n,): how far [m] a disc around the cell's corners may go beyond it without leaving the zone.
    """
    here, far = np.array((column, row)), reach + 2.0 * HALF_DIAGONAL
    around = ceil(far / CELL)
    places, depths = [np.empty((0, 2))], [np.empty(0)]
    for zone in zones:
        if zone.cells is not None:
            cells, layers = zone.cells.near(column, row, around)
            close = np.sum((cells - here) ** 2, axis=1) * CELL**2 <= far**2
            places.append(_middles(cells[close]))
            depths.append(np.maximum((layers[close] + 0.5) * CELL - HALF_DIAGONAL, 0.0))
            continue
        corners = zone.corners((0.0, 0.0, 0.0))
        cells = _cells(corners, CELL, here - around, here + around)
        cells = cells[np.sum((cells - here) ** 2, axis=1) * CELL**2 <= far**2]
        middles = _middles(cells)
        away, within = distance_to_border(corners, middles), polygon_contains(corners, middles)
        taken = within | (away <= HALF_DIAGONAL + 1e-9)
        places.append(middles[taken])
        depths.append(np.where(within, np.maximum(away - HALF_DIAGONAL, 0.0), 0.0)[taken])
    return np.vstack(places), np.concatenate(depths)
