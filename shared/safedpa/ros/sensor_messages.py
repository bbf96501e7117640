"""Contents of sensor messages as arrays: point clouds, depth images, ranges, grids and polygons.

Arguments are decoded messages (``encoding.decode``). Every size in a message is compared with its bytes before it is
used. A message that contradicts itself raises DecodingError with one sentence, so that its source counts as silent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.ros.decoding import DecodingError

__all__ = [
    "CAMERA_INFO",
    "CLOUD",
    "COSTMAP",
    "DEPTH_IMAGE",
    "GRID",
    "POLYGON",
    "POLYGON_INSTANCE",
    "RANGE",
    "Cone",
    "CostGrid",
    "Pinhole",
    "cone_of",
    "corners_of",
    "covering_capsule",
    "depth_of",
    "flat_yaw",
    "grid_of",
    "outline_points",
    "pinhole_of",
    "points_of",
    "points_of_depth",
]

CLOUD: Final = "sensor_msgs/msg/PointCloud2"
DEPTH_IMAGE: Final = "sensor_msgs/msg/Image"
CAMERA_INFO: Final = "sensor_msgs/msg/CameraInfo"
RANGE: Final = "sensor_msgs/msg/Range"
GRID: Final = "nav_msgs/msg/OccupancyGrid"
COSTMAP: Final = "nav2_msgs/msg/Costmap"
POLYGON: Final = "geometry_msgs/msg/PolygonStamped"
POLYGON_INSTANCE: Final = "geometry_msgs/msg/PolygonInstanceStamped"

_MOST_POINTS = 2_000_000
"""Points, pixels or cells of one message; a 128-beam lidar sends 260,000 points."""
_MOST_CORNERS = 512
_MOST_ON_EDGE = 1000
"""Points on one edge."""
_LARGEST_METRES = 1e4
_FLOATS = {7: "f4", 8: "f8"}
"""``datatype`` of ``sensor_msgs/PointField`` that holds coordinates."""
_DEPTHS = {"32FC1": ("f4", 1.0), "16UC1": ("u2", 0.001), "mono16": ("u2", 0.001)}
"""Number format and metres per unit of each ``encoding`` (ROS REP 118)."""
_LETHAL, _UNKNOWN, _SCALED = 254, 255, 252
"""Costs of ``nav2_msgs/Costmap``: an obstacle, no information, and the largest cost below the inscribed radius."""


def points_of(message: Any, every: int = 1) -> FloatArray:
    """Returns the points (points, 3) [m] of a PointCloud2 in its frame; every n-th, without those that are not finite.

    Raises DecodingError if it has no x, y, z of 4 or 8 bytes, or if its sizes contradict each other.
    """
    width, height = int(message.width), int(message.height)
    step, row = int(message.point_step), int(message.row_step)
    if width * height == 0:
        return np.empty((0, 3))
    if width * height > _MOST_POINTS:
        raise DecodingError(f"it has {width * height} points, wanted {_MOST_POINTS} at most")
    layout = {field.name: field for field in message.fields}
    if not {"x", "y", "z"} <= layout.keys():
        raise DecodingError(f"it has the fields {', '.join(sorted(layout))[:80] or 'none'}, wanted x, y and z")
    order = ">" if message.is_bigendian else "<"
    formats, offsets = [], []
    for axis in "xyz":
        kind = _FLOATS.get(int(layout[axis].datatype))
        if kind is None:
            raise DecodingError(f"its {axis} has the datatype {layout[axis].datatype}, wanted FLOAT32 or FLOAT64")
        formats.append(order + kind)
        offsets.append(int(layout[axis].offset))
        if offsets[-1] + int(kind[1]) > step:
            raise DecodingError(f"its {axis} is beyond its point_step of {step} bytes")
    if row < width * step or len(message.data) < row * (height - 1) + width * step:
        raise DecodingError(f"its data have {len(message.data)} bytes, wanted {height} rows of {width} x {step}")
    whole = np.ndarray(
        (height, width),
        dtype=np.dtype({"names": list("xyz"), "formats": formats, "offsets": offsets, "itemsize": step}),
        buffer=np.ascontiguousarray(message.data, dtype=np.uint8),
        strides=(row, step),
    )
    flat = whole.reshape(-1)[:: max(every, 1)]
    table = np.column_stack([flat[axis].astype(np.float64) for axis in "xyz"])
    return table[(np.abs(table) < _LARGEST_METRES).all(axis=1)]  # False for NaN, too


def depth_of(message: Any) -> FloatArray:
    """Returns the depth (rows, columns) [m] of an Image of encoding 32FC1 or 16UC1; NaN: not measured.

    Infinity stays: nothing was in range (ROS REP 118). Raises DecodingError for other encodings and wrong sizes.
    """
    rows, columns, step = int(message.height), int(message.width), int(message.step)
    if message.encoding not in _DEPTHS:
        raise DecodingError(f"its encoding is '{message.encoding[:20]}', wanted 32FC1 (m) or 16UC1 (mm)")
    kind, unit = _DEPTHS[message.encoding]
    size = int(kind[1])
    if min(rows, columns) < 2 or rows * columns > _MOST_POINTS:
        raise DecodingError(f"it has {rows} x {columns} pixels, wanted 2 x 2 to {_MOST_POINTS} in all")
    if step < columns * size or len(message.data) < step * (rows - 1) + columns * size:
        raise DecodingError(f"its data have {len(message.data)} bytes, wanted {rows} rows of {columns} x {size}")
    raw = np.ndarray(
        (rows, columns),
        dtype=(">" if message.is_bigendian else "<") + kind,
        buffer=np.ascontiguousarray(message.data, dtype=np.uint8),
        strides=(step, size),
    )
    depth: FloatArray = raw.astype(np.float64) * unit
    depth[~(depth > 0.0)] = np.nan
    return depth


@final
@dataclass(frozen=True)
class Pinhole:
    """Intrinsics of a camera [pixels], and the size of the image for which they are valid."""

    fx: float
    fy: float
    cx: float
    cy: float
    rows: int
    columns: int


def pinhole_of(message: Any) -> Pinhole:
    """Returns the intrinsics in a CameraInfo; raises DecodingError if they are not finite or not positive."""
    matrix = np.asarray(message.k, dtype=np.float64).reshape(-1)
    rows, columns = int(message.height), int(message.width)
    if len(matrix) != 9 or not np.isfinite(matrix).all() or not (matrix[0] > 0.0 and matrix[4] > 0.0):
        raise DecodingError("its matrix K is not finite, or has no focal length: the camera is not calibrated")
    if not (0.0 <= matrix[2] <= columns and 0.0 <= matrix[5] <= rows):
        raise DecodingError(f"its principal point is outside its image of {rows} x {columns} pixels")
    fx, fy, cx, cy = (float(matrix[index]) for index in (0, 4, 2, 5))
    return Pinhole(fx, fy, cx, cy, rows, columns)


def points_of_depth(depth: FloatArray, camera: Pinhole, every: int = 1) -> FloatArray:
    """Returns the points (points, 3) [m] of a depth image (rows, columns), every n-th row and column.

    In the optical frame: x to the right, y down, z ahead (ROS REP 103). Raises DecodingError if the image has another
    size than the CameraInfo.
    """
    if depth.shape != (camera.rows, camera.columns):
        raise DecodingError(
            f"it has {depth.shape[0]} x {depth.shape[1]} pixels, its CameraInfo {camera.rows} x {camera.columns}; "
            "wanted the topic of the same image"
        )
    part = depth[:: max(every, 1), :: max(every, 1)]
    v, u = np.nonzero(np.isfinite(part) & (part < _LARGEST_METRES))
    z = part[v, u]
    scale = max(every, 1)
    return np.column_stack([(u * scale - camera.cx) * z / camera.fx, (v * scale - camera.cy) * z / camera.fy, z])


@final
@dataclass(frozen=True)
class Cone:
    """One measurement of a range sensor: something at ``distance`` [m] within ``field_of_view`` [rad], or nothing."""

    distance: float
    """Infinity: nothing within ``farthest``; NaN: not measured; ``nearest``: nearer than it can measure."""
    field_of_view: float
    nearest: float
    farthest: float


def cone_of(message: Any) -> Cone:
    """Returns the measurement of a ``sensor_msgs/Range`` (ROS REP 117); raises DecodingError for invalid limits.

    A sensor of fixed distance has equal limits: -inf is a detection there, inf is none.
    """
    nearest, farthest = float(message.min_range), float(message.max_range)
    view, distance = float(message.field_of_view), float(message.range)
    if not (0.0 <= nearest <= farthest <= _LARGEST_METRES and farthest > 0.0):
        raise DecodingError(f"its range is {nearest:g} to {farthest:g} m, wanted the lower first")
    if not 1e-3 <= view <= math.pi:
        raise DecodingError(f"its field of view is {view:g} rad, wanted 0.001 to {math.pi:.2f}")
    if nearest == farthest:  # a switch
        nearest = 0.0
        distance = farthest if distance == -math.inf else math.inf if math.isinf(distance) else distance
    if distance == -math.inf or distance < nearest:
        distance = nearest
    elif distance > farthest:
        distance = math.inf
    return Cone(distance, view, nearest, max(farthest, nearest + 1e-3))


@final
@dataclass(frozen=True)
class CostGrid:
    """Cells (rows, columns) of 0 (free) to 100 (an obstacle), -1 unknown, as ``nav_msgs/OccupancyGrid`` has them."""

    cells: IndexArray
    resolution: float
    """Edge of a cell [m]."""
    origin: tuple[float, float, float]
    """Pose of the corner of cell (0, 0) in the frame of the message: x, y [m] and yaw [rad]."""


def grid_of(message: Any) -> CostGrid:
    """Returns the cells of an OccupancyGrid or of a ``nav2_msgs/Costmap``; raises DecodingError if sizes differ."""
    if hasattr(message, "metadata"):
        about, columns, rows = message.metadata, int(message.metadata.size_x), int(message.metadata.size_y)
        raw = np.asarray(message.data, dtype=np.uint8).astype(np.int64)
        cells = np.where(raw <= _SCALED, raw * 98 // _SCALED, raw - _LETHAL + 100)  # 253, the inscribed radius: 99
        cells[raw == _UNKNOWN] = -1
    else:
        about, columns, rows = message.info, int(message.info.width), int(message.info.height)
        cells = np.asarray(message.data, dtype=np.int8).astype(np.int64)
    resolution, place = float(about.resolution), about.origin.position
    if not 0 < rows * columns <= _MOST_POINTS or len(cells) != rows * columns:
        raise DecodingError(f"it has {len(cells)} cells, wanted {rows} x {columns}, at most {_MOST_POINTS}")
    if not 0.005 <= resolution <= 5.0:
        raise DecodingError(f"its cells have {resolution:g} m, wanted 0.005 to 5")
    turn = about.origin.orientation
    origin = (float(place.x), float(place.y), flat_yaw(turn.x, turn.y, turn.z, turn.w))
    if not all(abs(value) <= _LARGEST_METRES for value in origin):
        raise DecodingError("its origin is not finite, tilted, or implausibly far away")
    if int(cells.min()) < -1 or int(cells.max()) > 100:
        cells = np.where((cells < -1) | (cells > 100), -1, cells)
    return CostGrid(cells.reshape(rows, columns), resolution, origin)


def flat_yaw(x: float, y: float, z: float, w: float) -> float:
    """Returns the yaw [rad] of a quaternion about the vertical axis; 0 for (0, 0, 0, 0), NaN if it is tilted."""
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if norm == 0.0:
        return 0.0  # left out by the sender
    tilted = not math.isfinite(norm) or abs(norm - 1.0) > 0.1 or math.hypot(x, y) > 0.02 * norm
    return math.nan if tilted else 2.0 * math.atan2(z, w)


def corners_of(message: Any) -> FloatArray:
    """Returns the corners (corners, 3) [m] of a PolygonStamped or PolygonInstanceStamped.

    Raises DecodingError for fewer than 3 or bad ones.
    """
    points = getattr(message.polygon, "polygon", message.polygon).points
    if not 3 <= len(points) <= _MOST_CORNERS:
        raise DecodingError(f"its polygon has {len(points)} corners, wanted 3 to {_MOST_CORNERS}")
    corners = np.array([(point.x, point.y, point.z) for point in points], dtype=np.float64)
    if not (np.abs(corners) < _LARGEST_METRES).all():
        raise DecodingError("a corner of its polygon is not finite or implausibly far away")
    return corners


def outline_points(corners: FloatArray, apart: float) -> FloatArray:
    """Returns points (points, 3) on the edges of a polygon (corners, 3), at most ``apart`` [m] from each other."""
    found = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        count = min(max(math.ceil(float(np.linalg.norm(end - start)) / apart), 1), _MOST_ON_EDGE)
        found.append(start + np.linspace(0.0, 1.0, count, endpoint=False)[:, np.newaxis] * (end - start))
    return np.vstack(found)


def covering_capsule(corners: FloatArray) -> tuple[float, float, float]:
    """Returns extent behind and ahead of the origin and radius [m] of a capsule along x that contains a polygon.

    Of the capsules that contain all ``corners`` (corners, 2), it has the least area of those tried. A capsule is
    convex, so it contains the whole polygon.

    Example:

        >>> import numpy as np
        >>> from safedpa.ros.sensor_messages import covering_capsule
        >>> covering_capsule(np.array([[0.2, 0.1], [0.2, -0.1], [-0.2, -0.1], [-0.2, 0.1]]))[2] < 0.15
        True
    """
    x, y = corners[:, 0], corners[:, 1]
    least, most = float(np.abs(y).max()), float(np.hypot(x - 0.5 * (x.max() + x.min()), y).max())
    best = (math.inf, (0.0, 0.0, 0.0))
    for radius in np.linspace(max(least, 1e-3), max(most, least, 1e-3), 25):
        aside = np.sqrt(np.maximum(radius**2 - y**2, 0.0))
        front, rear = float((x - aside).max()), float((-x - aside).max())
        middle = 0.5 * (front - rear)
        front, rear = max(front, middle), max(rear, -middle)  # a disc, where the ends would cross
        area = math.pi * radius**2 + 2.0 * radius * (front + rear)
        best = min(best, (area, (rear, front, float(radius))))
    return best[1]
