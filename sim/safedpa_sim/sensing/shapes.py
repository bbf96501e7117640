"""Outlines of objects seen from above, as circles and edges, with ray casting and clearances."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import cos, inf, sin

import numpy as np

from safedpa.arrays import FloatArray

Point = tuple[float, float]
Polygon = tuple[Point, ...]
"""Corners of a convex polygon in m, anticlockwise."""

_PARALLEL = 1e-12
"""Sine of the angle between a ray and an edge below which they count as parallel."""


def box(x: float, y: float, length: float, width: float, yaw: float = 0.0) -> Polygon:
    """Returns a rectangle centred at (x, y) [m], rotated by ``yaw`` [rad]."""
    along, across = (cos(yaw), sin(yaw)), (-sin(yaw), cos(yaw))
    return tuple(
        (x + a * along[0] + b * across[0], y + a * along[1] + b * across[1])
        for a, b in (
            (-length / 2, -width / 2),
            (length / 2, -width / 2),
            (length / 2, width / 2),
            (-length / 2, width / 2),
        )
    )


@dataclass(frozen=True)
class Outline:
    """Everything that a ray can hit at one time; lengths in m."""

    circles: tuple[tuple[float, float, float], ...] = ()
    """x, y, radius of each."""
    polygons: tuple[Polygon, ...] = ()
    rooms: tuple[tuple[float, float, float, float], ...] = ()
    """Lowest x, highest x, lowest y, highest y of each rectangle that is seen from inside, such as the walls."""
    edges: FloatArray = field(init=False, repr=False, compare=False)
    """(edges, 4): x and y of both ends."""
    discs: FloatArray = field(init=False, repr=False, compare=False)
    """(circles, 3)."""

    def __post_init__(self) -> None:
        corners = [*self.polygons, *(_corners(*room) for room in self.rooms)]
        rows = [
            (*one, *other) for polygon in corners for one, other in zip(polygon, polygon[1:] + polygon[:1], strict=True)
        ]
        object.__setattr__(self, "discs", np.array(self.circles, dtype=np.float64).reshape(-1, 3))
        object.__setattr__(self, "edges", np.array(rows, dtype=np.float64).reshape(-1, 4))


def _corners(low_x: float, high_x: float, low_y: float, high_y: float) -> Polygon:
    return (low_x, low_y), (high_x, low_y), (high_x, high_y), (low_x, high_y)


def cast(outline: Outline, x: float, y: float, angles: FloatArray) -> FloatArray:
    """Returns the distance [m] from (x, y) to the first hit along each of ``angles`` (rays,) [rad], or infinity."""
    ahead, aside = np.cos(angles), np.sin(angles)
    return np.minimum(_to_edges(outline.edges, x, y, ahead, aside), _to_circles(outline.discs, x, y, ahead, aside))


def _to_edges(edges: FloatArray, x: float, y: float, ahead: FloatArray, aside: FloatArray) -> FloatArray:
    """Solves p + t d = a + s (b - a) for each ray d and edge (a, b) with 0 <= s <= 1; returns the least t >= 0."""
    if not len(edges):
        return np.full(len(ahead), inf)
    start_x, start_y = (edges[:, 0] - x)[:, np.newaxis], (edges[:, 1] - y)[:, np.newaxis]
    way_x, way_y = (edges[:, 2] - edges[:, 0])[:, np.newaxis], (edges[:, 3] - edges[:, 1])[:, np.newaxis]
    cross = ahead * way_y - aside * way_x
    meets = np.abs(cross) > _PARALLEL
    safe = np.where(meets, cross, 1.0)
    distance = (start_x * way_y - start_y * way_x) / safe
    share = (start_x * aside - start_y * ahead) / safe
    hit = meets & (distance >= 0.0) & (share >= 0.0) & (share <= 1.0)
    least: FloatArray = np.where(hit, distance, inf).min(axis=0)
    return least


def _to_circles(table: FloatArray, x: float, y: float, ahead: FloatArray, aside: FloatArray) -> FloatArray:
    if not len(table):
        return np.full(len(ahead), inf)
    apart_x, apart_y = (table[:, 0] - x)[:, np.newaxis], (table[:, 1] - y)[:, np.newaxis]
    along = apart_x * ahead + apart_y * aside
    across = apart_x * aside - apart_y * ahead
    half = table[:, 2:] ** 2 - across**2
    reach = along - np.sqrt(np.maximum(half, 0.0))
    least: FloatArray = np.where((half >= 0.0) & (reach >= 0.0), reach, inf).min(axis=0)
    return least


def clearance_at(outline: Outline, x: float, y: float) -> float:
    """Returns the distance [m] from (x, y) to the nearest object; negative inside a circle."""
    return float(clearances_at(outline, np.array([[x, y]]))[0])


def clearances_at(outline: Outline, positions: FloatArray) -> FloatArray:
    """Returns the distance [m] from each of ``positions`` (n, 2) to the nearest object; negative inside a circle."""
    rooms: FloatArray = np.full(len(positions), inf)
    if len(outline.discs):
        apart = positions[:, np.newaxis] - outline.discs[:, :2]
        rooms = (np.hypot(apart[..., 0], apart[..., 1]) - outline.discs[:, 2]).min(axis=1)
    if len(outline.edges):
        start, way = outline.edges[:, :2], outline.edges[:, 2:] - outline.edges[:, :2]
        apart = positions[:, np.newaxis] - start
        share = np.clip((apart * way).sum(axis=2) / (way * way).sum(axis=1), 0.0, 1.0)
        apart -= share[..., np.newaxis] * way
        rooms = np.minimum(rooms, np.hypot(apart[..., 0], apart[..., 1]).min(axis=1))
    return rooms
