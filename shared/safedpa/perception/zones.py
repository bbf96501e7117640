"""Zones that the user marks: ``ignored`` zones, whose content is not reported, and ``closed`` ones, kept out of.

A zone is a polygon, or the occupied cells of a map. ``ActiveZones`` are those of the settings file after the orders of
users.
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
_MIN_VERTICES, _MAX_VERTICES = 3, 64
"""Allowed number of vertices of a polygon."""
_MAX_PUBLISHED_VERTICES = 512
"""Largest number of vertices that are published for display: 14 KB in each message."""
_MAX_COORDINATE = 1e5
"""m; largest coordinate of a vertex in its frame."""
_MIN_AREA = 1e-6
"""m2; with a smaller area the vertices are on one line, apart from rounding."""
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,60}")
"""Names are restricted because orders have the form NAME=on."""
HALF_DIAGONAL = CELL / 2**0.5
"""Distance from the middle of a cell to its corners, m."""


@final
@dataclass(frozen=True)
class Zone:
    """A zone of ``kind`` in the ``frame`` of the states' positions (``map``) or of the robot's body (``robot``).

    It is a polygon; a closed zone in the frame of the map can have ``cells`` instead. Raises InputError that names the
    zone and the fault.
    """

    name: str
    kind: str
    polygon: Corners
    """Vertices (3 to 64, 2) [m] in order, clockwise or not; edges must not cross. Empty if there are ``cells``."""
    frame: str = "map"
    speed: tuple[float, float] | None = None
    """Range of |speed| of the robot [m/s] at which the zone is active; None for any speed."""
    robots: tuple[str, ...] = ()
    """Robots for which the zone is active; empty for all."""
    use: bool = True
    """Whether the zone is active unless a user switches it."""
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
        if not _MIN_VERTICES <= count <= _MAX_VERTICES:
            raise InputError(
                f"zone {self.name}: polygon: got {count} vertices, wanted {_MIN_VERTICES} to {_MAX_VERTICES}"
            )
        corners = np.array(self.polygon)
        if not np.all(np.isfinite(corners)) or np.abs(corners).max() > _MAX_COORDINATE:
            raise InputError(f"zone {self.name}: polygon: got a vertex beyond {_MAX_COORDINATE:g} m, wanted metres")
        duplicates = [corner for index, corner in enumerate(self.polygon) if corner in self.polygon[:index]]
        if duplicates:
            raise InputError(f"zone {self.name}: polygon: got the vertex {list(duplicates[0])} twice, wanted each once")
        crossing = _crossing(corners)
        if crossing:
            first, second = crossing
            raise InputError(
                f"zone {self.name}: polygon: edge {first + 1} meets edge {second + 1}; wanted the vertices in order "
                "around it"
            )
        if _area(corners) < _MIN_AREA:
            raise InputError(f"zone {self.name}: polygon: got no area, wanted vertices that are not in one line")

    def counts_for(self, robot: str) -> bool:
        """Whether the zone applies to this robot."""
        return not self.robots or robot in self.robots

    def counts_at(self, speed: float | None) -> bool:
        """Whether the zone is active at a speed [m/s]; at an unknown speed (None) only closed zones are."""
        if self.speed is None:
            return True
        if speed is None or not isfinite(speed):
            return self.kind == "closed"
        return self.speed[0] <= abs(speed) <= self.speed[1]

    def corners(self, pose: Pose) -> FloatArray:
        """Vertices (vertices, 2) [m] in the frame of the states' positions, for a robot at ``pose``."""
        corners = np.array(self.polygon)
        if self.frame == "map":
            return corners
        x, y, yaw = pose
        ahead, aside = corners.T
        return np.column_stack([x + ahead * cos(yaw) - aside * sin(yaw), y + ahead * sin(yaw) + aside * cos(yaw)])


@final
@dataclass(frozen=True)
class ActiveZones:
    """Active zones and disabled sources of one robot."""

    off: frozenset[str] = frozenset()
    """Names of its sources that are switched off."""
    zones: tuple[Zone, ...] = ()
    ordered: str = ""
    """Text of the orders and of the user who gave the last one; empty without orders."""

    @property
    def names(self) -> tuple[str, ...]:
        """Kind and name of each zone."""
        return tuple(f"{zone.kind} {zone.name}" for zone in self.zones)

    def borders(self, pose: Pose) -> tuple[tuple[float, float, float], ...]:
        """Vertices (n, 3) for display: index of the zone, x and y [m], for a robot at ``pose``.

        Limited to the first zones with ``_MAX_PUBLISHED_VERTICES`` vertices in total.
        """
        rows: list[tuple[float, float, float]] = []
        for number, zone in enumerate(self.zones):
            if zone.cells is not None:
                continue
            if len(rows) + len(zone.polygon) > _MAX_PUBLISHED_VERTICES:
                break
            rows += [(float(number), x, y) for x, y in zone.corners(pose).tolist()]
        return tuple(rows)

    def at(self, speed: float | None) -> ActiveZones:
        """Returns these without the zones that are inactive at a speed [m/s]."""
        return replace(self, zones=tuple(zone for zone in self.zones if zone.counts_at(speed)))

    def of_kind(self, kind: str, speed: float | None) -> tuple[Zone, ...]:
        """Returns the zones of one kind that are active at a speed [m/s]."""
        return tuple(zone for zone in self.zones if zone.kind == kind and zone.counts_at(speed))


CONFIGURED_ZONES = ActiveZones()


def _edges(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    return corners, np.roll(corners, -1, axis=0)


def _area(corners: FloatArray) -> float:
    start, end = _edges(corners)
    return float(abs(np.sum(start[:, 0] * end[:, 1] - end[:, 0] * start[:, 1])) / 2.0)


def _turn(one: FloatArray, other: FloatArray, third: FloatArray) -> float:
    """Positive if ``third`` lies to the left of the line from ``one`` to ``other``."""
    way, apart = other - one, third - one
    return float(way[0] * apart[1] - way[1] * apart[0])


def _crossing(corners: FloatArray) -> tuple[int, int] | None:
    """Two edges with a common point, other than the shared vertex of neighbours; None if there are none."""
    start, end = _edges(corners)
    count = len(corners)
    for i in range(count):
        for j in range(i + 1, count):
            neighbours = j == i + 1 or (i == 0 and j == count - 1)
            if _folds_back(start, end, i, j, count) if neighbours else _meet(start[i], end[i], start[j], end[j]):
                return i, j
    return None


def _folds_back(start: FloatArray, end: FloatArray, i: int, j: int, count: int) -> bool:
    """Whether the second of two neighbouring edges runs back over the first."""
    first, second = (i, j) if j == i + 1 else (j, i)
    if count == 3:
        return False  # caught by its area
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
    """Which of ``places`` (n, 2) are inside a polygon (vertices, 2), by the even-odd rule along a ray to the right."""
    within = np.zeros(len(places), dtype=bool)
    x, y = places.T.copy()
    for (from_x, from_y), (to_x, to_y) in zip(*(part.tolist() for part in _edges(corners)), strict=True):
        passes = np.flatnonzero((from_y > y) != (to_y > y))
        if len(passes):
            share = (y[passes] - from_y) / (to_y - from_y)
            within[passes] ^= x[passes] < from_x + share * (to_x - from_x)
    return within


def distance_to_border(corners: FloatArray, places: FloatArray) -> FloatArray:
    """Distance (n,) [m] from ``places`` (n, 2) to the nearest edge."""
    nearest = np.full(len(places), np.inf)
    x, y = places.T.copy()
    for (from_x, from_y), (to_x, to_y) in zip(*(part.tolist() for part in _edges(corners)), strict=True):
        way_x, way_y, apart_x, apart_y = to_x - from_x, to_y - from_y, x - from_x, y - from_y
        along = np.clip((apart_x * way_x + apart_y * way_y) / (way_x**2 + way_y**2), 0.0, 1.0)
        np.minimum(nearest, (apart_x - along * way_x) ** 2 + (apart_y - along * way_y) ** 2, out=nearest)
    distance: FloatArray = np.sqrt(nearest)
    return distance


def _cells(corners: FloatArray, margin: float, lowest: IndexArray, highest: IndexArray) -> IndexArray:
    """Column and row (n, 2) of all cells of the polygon's bounding box with ``margin`` [m], clipped to the range."""
    low = np.maximum(np.floor((corners.min(axis=0) - margin) / CELL).astype(np.int64), lowest)
    high = np.minimum(np.floor((corners.max(axis=0) + margin) / CELL).astype(np.int64), highest)
    ranges = [np.arange(first, last + 1) for first, last in zip(low.tolist(), high.tolist(), strict=True)]
    return np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, 2)


def _middles(cells: IndexArray) -> FloatArray:
    """Middles (n, 2) [m] of cells."""
    return np.asarray((cells + 0.5) * CELL, dtype=np.float64)


def within_any(zones: tuple[Zone, ...], places: FloatArray, pose: Pose) -> BoolArray:
    """Which of ``places`` (n, 2) [m] are inside any of the zones, for a robot at ``pose``."""
    found = np.zeros(len(places), dtype=bool)
    for zone in zones:
        found |= polygon_contains(zone.corners(pose), places)
    return found


def zone_entry_distance(
    zones: tuple[Zone, ...], pose: Pose, sensor: tuple[float, float], ends: FloatArray
) -> FloatArray:
    """Distance (n,) [m] at which rays from ``sensor`` to ``ends`` (n, 2) first enter the zone in which they end.

    Infinity for rays that end in no zone; 0 if the sensor itself is inside.
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
    """Distance (n,) [m] from ``here`` to the first edge towards each of ``ends`` (n, 2); 0 if none is met."""
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
    """Cells (size, size) in which nothing is assumed to hide: those of the zones, and those next to them."""
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
    """Middles (n, 2) [m] of all cells that overlap the zones, within ``reach`` [m] of any point of cell (column, row).

    Also returns their depth (n,) [m]: by how much a disc around a cell can be enlarged without leaving the zone.
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
