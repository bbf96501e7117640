"""Readings of any sensor as rays in the plane, so that perception treats all sources alike.

A laser scan is one already. Point clouds, depth images, range cones, grids and polygons become one by these functions:
each returns ``Rays``, and ``Rays.message`` is what goes on the bus. Stamp, age, time-out and health of a source follow
from the messages (``source_health``), under the name of the source.

A ray says at most two things: something is at ``ranges[i]``, and the way up to there, or up to ``free[i]``, is free.
Whatever a sensor did not measure stays unknown, which perception counts as occupied by something hidden.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, isfinite, pi, sin
from typing import Final, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.bus.messages.messages import ScanMessage
from safedpa.errors import InputError

__all__ = [
    "Camera",
    "HeightBand",
    "Rays",
    "rays_of_depth",
    "rays_of_grid",
    "rays_of_points",
    "rays_of_polygon",
    "rays_of_range",
]

_MOST_RAYS: Final = 1080
_CONE_RAYS: Final = 9
"""Rays of a range cone: at 2 m in 0.5 rad they are 0.13 m apart, about a cell of perception."""
_LARGEST: Final = 1e5
"""m; larger coordinates are no measurement."""


@final
@dataclass(frozen=True)
class Rays:
    """Rays from a sensor at ``mount``; the fields are those of ``ScanMessage``. Raises InputError for a bad shape."""

    mount: tuple[float, float, float]
    """x ahead of the robot's reference point, y to its left [m], and the yaw of the sensor's zero angle [rad]."""
    first_angle: float
    angle_step: float
    ranges: tuple[float, ...]
    """m; below 0: not measured; ``farthest`` or more: no return."""
    nearest: float
    farthest: float
    free: tuple[float, ...] = ()
    """m; up to where a ray without a return saw free space. Empty: it saw none."""

    def __post_init__(self) -> None:
        if not 2 <= len(self.ranges) <= _MOST_RAYS or len(self.free) not in (0, len(self.ranges)):
            raise InputError(
                f"rays: got {len(self.ranges)} ranges and {len(self.free)} free lengths, wanted 2 to {_MOST_RAYS} "
                "ranges, and as many free lengths or none"
            )
        _check_mount(self.mount)
        if not 0.0 <= self.nearest < self.farthest <= _LARGEST:
            raise InputError(f"ranges: got {self.nearest:g} to {self.farthest:g} m, wanted the nearest first, finite")

    def message(self, source: str, number: int, epoch: int, tick: int, robot_time: float) -> ScanMessage:
        """Returns the message of the source, measured at ``robot_time`` [s] of the robot's clock."""
        return ScanMessage(
            epoch=epoch,
            tick=tick,
            robot_time=robot_time,
            publish_time=time.time(),
            source=source,
            mount=self.mount,
            first_angle=self.first_angle,
            angle_step=self.angle_step,
            ranges=self.ranges,
            nearest=self.nearest,
            farthest=self.farthest,
            number=number,
            free=self.free,
        )


@final
@dataclass(frozen=True)
class HeightBand:
    """Heights above the ground [m] at which a point is an obstacle; below it is ground, above the robot passes.

    Raises InputError unless low < high.
    """

    low: float = 0.05
    high: float = 1.0

    def __post_init__(self) -> None:
        if not (isfinite(self.low) and isfinite(self.high) and self.low < self.high):
            raise InputError(f"height band: got {self.low:g} to {self.high:g} m, wanted the lower first, finite")


@final
@dataclass(frozen=True)
class Camera:
    """A pinhole camera: ``fx``, ``fy``, ``cx``, ``cy`` [pixels], and its pose in the body frame.

    ``pitch`` > 0 looks down. A pixel (column u, row v) of depth d is the point d (1, (cx - u) / fx, (cy - v) / fy) in a
    frame that looks along x. Raises InputError for focal lengths that are not positive.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    x: float = 0.0
    y: float = 0.0
    z: float = 0.3
    """m above the ground."""
    yaw: float = 0.0
    pitch: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, self.x, self.y, self.z, self.yaw, self.pitch)
        if not all(map(isfinite, numbers)) or self.fx <= 0.0 or self.fy <= 0.0:
            raise InputError(f"camera: got {numbers}, wanted finite numbers and focal lengths above 0 pixels")

    @property
    def mount(self) -> tuple[float, float, float]:
        """x, y [m] and yaw [rad] in the body frame."""
        return self.x, self.y, self.yaw


def rays_of_points(
    points: ArrayLike,
    mount: tuple[float, float, float],
    *,
    band: HeightBand | None = None,
    field_of_view: float = 2.0 * pi,
    rays: int = 360,
    nearest: float = 0.05,
    farthest: float = 12.0,
) -> Rays:
    """Returns the rays of points (n, 2) or (n, 3) [m] in the body frame, seen from ``mount``.

    Each ray has the nearest point of its sector that is in the ``band``. A sector with ground alone (z below the band)
    is free up to its farthest ground point. Points that are not finite are left out. Raises InputError for a wrong
    shape or number of rays.

    Example:

        >>> from safedpa.perception import rays_of_points
        >>> seen = rays_of_points([[2.0, 0.0, 0.5], [3.0, 0.0, 0.5]], (0.0, 0.0, 0.0), rays=4)
        >>> [round(one, 2) for one in seen.ranges]
        [12.0, 12.0, 2.0, 12.0]
    """
    table = np.asarray(points, dtype=np.float64)
    table = table.reshape(0, 3) if table.size == 0 else table
    if table.ndim != 2 or table.shape[1] not in (2, 3):
        raise InputError(f"points: got shape {table.shape}, wanted (points, 2) or (points, 3): x, y, z in m")
    first, step = _sectors(field_of_view, rays)
    _check_mount(mount)
    table = table[np.isfinite(table).all(axis=1) & (np.abs(table) < _LARGEST).all(axis=1)]
    x, y, yaw = mount
    away_x, away_y = table[:, 0] - x, table[:, 1] - y
    distance = np.hypot(away_x, away_y)
    turn = np.mod(np.arctan2(away_y, away_x) - yaw - first + 0.5 * step, 2.0 * pi)
    sector = np.floor(turn / step).astype(np.int64)
    band = band or HeightBand()
    height = table[:, 2] if table.shape[1] == 3 else np.full(len(table), band.low)
    usable = (sector < rays) & (distance >= nearest) & (distance < farthest)
    hit, ground = usable & (height >= band.low) & (height <= band.high), usable & (height < band.low)
    ranges, free = np.full(rays, farthest), np.zeros(rays)
    np.minimum.at(ranges, sector[hit], distance[hit])
    np.maximum.at(free, sector[ground], distance[ground])
    return Rays(mount, first, step, tuple(ranges.tolist()), nearest, farthest, tuple(free.tolist()))


def rays_of_depth(
    depth: ArrayLike,
    camera: Camera,
    *,
    band: HeightBand | None = None,
    rays: int = 120,
    nearest: float = 0.2,
    farthest: float = 6.0,
) -> Rays:
    """Returns the rays of a depth image (rows, columns) [m]; 0, NaN and infinity are pixels without depth.

    Raises InputError for a wrong shape, or a camera that sees half a turn or more.
    """
    image = np.asarray(depth, dtype=np.float64)
    if image.ndim != 2 or min(image.shape) < 2:
        raise InputError(f"depth image: got shape {image.shape}, wanted (rows, columns) of at least 2 each")
    columns = image.shape[1]
    measured = np.isfinite(image) & (image > 0.0)
    v, u = np.nonzero(measured)
    d = image[measured]
    ahead, left, up = d, d * (camera.cx - u) / camera.fx, d * (camera.cy - v) / camera.fy
    level = ahead * cos(camera.pitch) + up * sin(camera.pitch)
    height = camera.z - ahead * sin(camera.pitch) + up * cos(camera.pitch)
    x = camera.x + level * cos(camera.yaw) - left * sin(camera.yaw)
    y = camera.y + level * sin(camera.yaw) + left * cos(camera.yaw)
    view = 2.0 * min(np.arctan(camera.cx / camera.fx), np.arctan((columns - 1 - camera.cx) / camera.fx))
    if not view > 0.0:
        raise InputError(f"camera: got cx {camera.cx:g} outside an image of {columns} columns, wanted it inside")
    return rays_of_points(
        np.column_stack([x, y, height]), camera.mount, band=band, field_of_view=float(view),
        rays=min(rays, columns), nearest=nearest, farthest=farthest,
    )  # fmt: skip


def rays_of_range(
    distance: float, field_of_view: float, mount: tuple[float, float, float], nearest: float, farthest: float
) -> Rays:
    """Returns the rays of one range sensor (ultrasound, infrared) with a cone of ``field_of_view`` [rad].

    Something is anywhere on the arc at ``distance`` [m], so all of the arc is occupied. Farther than ``farthest`` or
    infinite: no return; below ``nearest`` or NaN: not measured.
    """
    first, step = _sectors(field_of_view, _CONE_RAYS)
    measured = distance >= nearest
    one = -1.0 if not measured else min(distance, farthest)
    return Rays(mount, first, step, (one,) * _CONE_RAYS, nearest, farthest)


def rays_of_grid(
    cells: ArrayLike,
    resolution: float,
    origin: tuple[float, float, float],
    *,
    sensor: tuple[float, float] = (0.0, 0.0),
    occupied: int = 65,
    rays: int = 360,
    farthest: float = 5.0,
) -> Rays:
    """Returns the rays of an occupancy grid or costmap (rows, columns) of 0 to 100, -1 unknown, as ROS defines it.

    ``origin`` is the pose of the grid's first corner in the body frame, ``resolution`` the edge of a cell [m]. A ray is
    free up to the first cell that is occupied, unknown or outside the grid; only an occupied one is a return. Raises
    InputError for a wrong shape or resolution.
    """
    table = np.asarray(cells)
    if table.ndim != 2 or not (isfinite(resolution) and 0.005 <= resolution <= 5.0):
        raise InputError(
            f"grid: got shape {table.shape} and cells of {resolution:g} m, wanted (rows, columns) and 0.005 to 5 m"
        )
    first, step = _sectors(2.0 * pi, rays)
    angles = first + step * np.arange(rays)
    pace = 0.5 * resolution
    along = pace * np.arange(1, int(farthest / pace) + 1)
    x, y = sensor[0] + np.outer(np.cos(angles), along), sensor[1] + np.outer(np.sin(angles), along)
    left, low, yaw = origin
    column = np.floor((cos(yaw) * (x - left) + sin(yaw) * (y - low)) / resolution).astype(np.int64)
    row = np.floor((cos(yaw) * (y - low) - sin(yaw) * (x - left)) / resolution).astype(np.int64)
    inside = (row >= 0) & (row < table.shape[0]) & (column >= 0) & (column < table.shape[1])
    value = np.full(x.shape, -1, dtype=np.int64)
    value[inside] = table[row[inside], column[inside]]
    ends = (value < 0) | (value >= occupied)
    index = np.where(ends.any(axis=1), ends.argmax(axis=1), len(along) - 1)
    at = value[np.arange(rays), index]
    length = along[index]
    ranges = np.where(at >= occupied, length, farthest + pace)
    free = np.where(at >= occupied, 0.0, np.maximum(length - pace, 0.0))
    mount = (*sensor, 0.0)
    return Rays(mount, first, step, tuple(ranges.tolist()), 0.0, farthest + pace, tuple(free.tolist()))


def rays_of_polygon(
    corners: Sequence[Sequence[float]],
    *,
    sensor: tuple[float, float] = (0.0, 0.0),
    rays: int = 360,
    farthest: float = 12.0,
) -> Rays:
    """Returns the rays that hit a polygon (corners, 2) [m] in the body frame, such as a tracked object's outline.

    Rays that miss it saw nothing: a polygon does not say what is free elsewhere. Raises InputError for fewer than two
    corners.
    """
    table = np.asarray(corners, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] != 2 or len(table) < 2 or not np.isfinite(table).all():
        raise InputError(f"polygon: got shape {table.shape}, wanted (corners, 2) of two or more finite corners in m")
    first, step = _sectors(2.0 * pi, rays)
    angles = first + step * np.arange(rays)
    way = np.column_stack([np.cos(angles), np.sin(angles)])
    least: FloatArray = np.full(rays, farthest)
    for start, end in zip(table - sensor, np.roll(table, -1, axis=0) - sensor, strict=True):
        edge = end - start
        across = way[:, 0] * edge[1] - way[:, 1] * edge[0]
        safe = np.where(np.abs(across) < 1e-12, np.inf, across)
        length = (start[0] * edge[1] - start[1] * edge[0]) / safe
        share = (start[0] * way[:, 1] - start[1] * way[:, 0]) / safe
        met = np.isfinite(safe) & (length >= 0.0) & (share >= 0.0) & (share <= 1.0)
        least = np.minimum(least, np.where(met, length, farthest))
    return Rays((*sensor, 0.0), first, step, tuple(least.tolist()), 0.0, farthest)


def _check_mount(mount: Sequence[float]) -> None:
    if len(mount) != 3 or not all(map(isfinite, mount)):
        raise InputError(f"mount: got {tuple(mount)}, wanted x, y in m and yaw in rad, finite")


def _sectors(field_of_view: float, rays: int) -> tuple[float, float]:
    """Returns the first angle and the step [rad] of rays that are symmetric about angle 0."""
    if not 2 <= rays <= _MOST_RAYS or not 1e-3 <= field_of_view <= 2.0 * pi + 1e-9:
        raise InputError(
            f"rays: got {rays} in {field_of_view:g} rad, wanted 2 to {_MOST_RAYS} in 0.001 rad to a full turn"
        )
    whole = field_of_view >= 2.0 * pi - 1e-9
    step = field_of_view / (rays if whole else rays - 1)
    return (-pi if whole else -0.5 * field_of_view), step
