"""The sensors of ``[[sources]]``: each message becomes rays for perception, and points for the speed zones.

A message that cannot be used is refused with a reason, and its source then counts as silent: perception reports it
after the time-out, and the robot brakes. Conversion runs on the network's thread.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from safedpa.arrays import BoolArray, FloatArray
from safedpa.errors import InputError
from safedpa.perception import HeightBand, Rays, rays_of_grid, rays_of_points, rays_of_polygon, rays_of_range
from safedpa.perception.zones import polygon_contains
from safedpa.ros.decoding import DecodingError
from safedpa.ros.encoding import decode
from safedpa.ros.graph import Attachment
from safedpa.ros.sensor_messages import (
    CLOUD,
    COSTMAP,
    DEPTH_IMAGE,
    GRID,
    POLYGON,
    POLYGON_INSTANCE,
    RANGE,
    Pinhole,
    cone_of,
    corners_of,
    depth_of,
    grid_of,
    outline_points,
    pinhole_of,
    points_of,
    points_of_depth,
)
from safedpa.ros.transforms import OPTICAL, TransformTree, pose_matrix, roll_pitch_yaw
from safedpa_services.ros_gateway.publisher_monitor import TWO_PUBLISHERS
from safedpa_services.ros_gateway.robot_file import RobotFile
from safedpa_services.ros_gateway.sensor_inputs import (
    TRANSFORMS,
    Frame,
    LatestMessage,
    PoseAndTwist,
    Receiver,
    TransformListener,
    nanoseconds,
)
from safedpa_services.ros_gateway.sensor_tables import LASER, ExclusionArea, FrameTopics, SourceTopic
from safedpa_services.ros_gateway.speed_zones import ToggleInput

__all__ = ["BodyFrames", "SourceReader", "SourceReading", "SourceReceiver", "body_frames", "laser_rays"]

_MOST_WAITING = 8
"""Readings that are stored between two periods."""
_MOST_RAYS, _MOST_SENT = 8192, 1080
"""Rays of a scan, and of one that perception accepts."""
_FARTHEST = 1000.0
"""m."""
_LARGEST_ANGLE = 4.0 * math.pi
"""Largest angle of the first ray [rad]."""
_SHORTEST_GAP = 0.03
"""s; of clouds, images and grids that arrive faster, the later ones are left out: 33 of 100 Hz are enough."""
_FLAT = 0.05
"""rad; a laser or range sensor that is tilted by less is in the plane."""
_GRID_RAYS = 720
"""Directions of a grid: at 5 m they are 4 cm apart, less than a usual cell."""
_MOST_POLYGONS = 64
"""Polygons of one source that are known at a time."""
_ARC_STEP = math.pi / 180.0
"""rad between the points of a range cone that count in speed zones, as in Nav2."""


@final
@dataclass(frozen=True)
class SourceReading:
    """One message of a source in the body frame, at the time of its measurement."""

    arrived: float
    """Time of arrival by this machine's clock [s]."""
    rays: Rays
    points: FloatArray
    """Points (points, 2) [m] that are obstacles."""
    pose: Frame | None = None
    """Pose of the reference point by odometry at that time; None: not known."""

    def points_at(self, pose: Frame | None) -> FloatArray:
        """Returns the points (points, 2) [m] in the body frame of the robot at another ``pose``."""
        return _moved_points(self.points, self.pose, pose)


@final
@dataclass(frozen=True)
class _Polygon:
    """A polygon of a source: corners (corners, 3) [m] in the body frame at ``pose``; arrival in s, stamp in ns."""

    arrived: float
    stamp: int
    corners: FloatArray
    pose: Frame | None


@final
class BodyFrames:
    """Poses of frames in the robot's body frame, whose origin is the reference point: from tf, or from odometry.

    :param ahead: distance [m] from the reference point to the origin of ``frames.base``
    :param pose_in: pose of the reference point in a frame of the world, or None for frames that are not known
    """

    def __init__(
        self,
        frames: FrameTopics,
        ahead: float,
        pose_in: Callable[[str], Frame | None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._frames, self._ahead, self._pose_in, self._clock = frames, ahead, pose_in, clock
        self.tree = TransformTree()
        self.refused = 0
        """Number of messages with transforms that could not be read."""

    def take_fixed(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message of ``/tf_static``, on the network's thread."""
        self._take(data, attachment, static=True)

    def take_moving(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message of ``/tf``, on the network's thread."""
        self._take(data, attachment, static=False)

    def _take(self, data: bytes, attachment: Attachment | None, *, static: bool) -> None:
        del attachment  # many nodes publish transforms
        try:
            self.tree.take(decode(TRANSFORMS, data), self._clock(), static=static)
        except DecodingError:
            self.refused += 1

    def pose_in(self, frame: str) -> Frame | None:
        """Returns the pose of the reference point in a frame of the world; None: not one, or not known."""
        return self._pose_in(frame.strip("/"))

    def of(self, frame: str, now: float, stamp: int = 0) -> FloatArray:
        """Returns the transform (4, 4) from ``frame`` to the body; raises DecodingError if it is missing or old."""
        base, plain = self._frames.base.strip("/"), frame.strip("/")
        offset = pose_matrix(self._ahead, 0.0, 0.0, 0.0, 0.0, 0.0)
        if plain == base:
            return offset
        pose = self._pose_in(plain)
        if pose is not None:
            x, y, yaw = pose
            cosine, sine = math.cos(yaw), math.sin(yaw)
            return pose_matrix(-cosine * x - sine * y, sine * x - cosine * y, 0.0, 0.0, 0.0, -yaw)
        chain = self.tree.chain(base, plain, now, stamp)
        if chain is None:
            raise DecodingError(f"there is no transform from '{plain[:60]}' to '{base}' yet")
        if chain.age > self._frames.largest_age:
            raise DecodingError(f"the transform from '{plain[:60]}' to '{base}' is {chain.age:.2f} s old")
        return offset @ chain.matrix


def body_frames(
    robot_file: RobotFile,
    odometry: LatestMessage,
    localised: TransformListener | None,
    clock: Callable[[], float] = time.monotonic,
) -> BodyFrames:
    """Returns the frames of a robot: those of the world by its odometry and localisation, others by tf."""

    def pose_in(frame: str) -> Frame | None:
        in_map = localised is not None and frame == robot_file.localisation.frame.strip("/")
        if frame != robot_file.wire.frame.strip("/") and not in_map:
            return None
        numbers, age, _ = odometry.read()
        if not numbers or age > robot_file.odometry.largest_age:
            return None
        pose = PoseAndTwist.of(numbers, robot_file.odometry.ahead)
        if in_map and localised is not None:
            if localised.read()[1] > robot_file.localisation.largest_age:
                return None
            pose = pose.seen_from(localised.read()[0])
        return (pose.x, pose.y, pose.yaw) if math.isfinite(pose.x + pose.y + pose.yaw) else None

    return BodyFrames(robot_file.frames, robot_file.odometry.ahead, pose_in, clock)


@final
class SourceReader:
    """Converts decoded messages of one source; raises DecodingError for those that cannot be used."""

    def __init__(
        self,
        topic: SourceTopic,
        areas: Sequence[ExclusionArea],
        frames: BodyFrames,
        odometry_frame: str = "odom",
        switches: Mapping[str, ToggleInput] | None = None,
    ) -> None:
        self.topic, self._frames, self._odometry_frame = topic, frames, odometry_frame
        self._own_areas = [area for area in areas if area.name in topic.exclusions]
        self._switches = switches or {area.name: ToggleInput(area.enabled) for area in self._own_areas}
        self._polygons: dict[int, _Polygon] = {}
        self._band = HeightBand(topic.height[0], topic.height[1])
        self.camera: Pinhole | None = None
        """Intrinsics of a depth camera; None before its CameraInfo arrived."""
        self._convert: Mapping[str, Callable[[Any, float, int], tuple[Rays, FloatArray]]] = {
            LASER: self._laser,
            CLOUD: self._cloud,
            DEPTH_IMAGE: self._depth,
            RANGE: self._range,
            GRID: self._grid,
            COSTMAP: self._grid,
            POLYGON: self._polygon,
            POLYGON_INSTANCE: self._polygon,
        }

    @property
    def _areas(self) -> list[ExclusionArea]:
        """Exclusions of this source that apply now."""
        return [area for area in self._own_areas if self._switches[area.name].on]

    def repeats(self, message: Any, stamp: int) -> bool:
        """Whether a polygon with a number has the stamp [ns] of the one before; 0: it has none."""
        known = self._polygons.get(int(message.polygon.id))
        return known is not None and known.stamp == stamp != 0

    def read(self, message: Any, now: float) -> SourceReading:
        """Returns the reading of a message that arrived at ``now`` [s]."""
        frame = message.header.frame_id.strip("/")
        if self.topic.frame and frame != self.topic.frame.strip("/"):
            raise DecodingError(f"its frame is '{frame[:60]}', wanted '{self.topic.frame}'")
        try:
            rays, points = self._convert[self.topic.type](message, now, nanoseconds(message.header.stamp))
        except InputError as error:
            raise DecodingError(str(error)) from error
        return SourceReading(now, rays, points, self._frames.pose_in(self._odometry_frame))

    def _mount(self, frame: str, now: float, stamp: int, *, optical: bool = False) -> FloatArray:
        """Transform (4, 4) from the frame of the message to the body."""
        given = self.topic.mount
        if not given:
            return self._frames.of(frame, now, stamp)
        x, y, z, roll, pitch, yaw = given if len(given) == 6 else (given[0], given[1], 0.0, 0.0, 0.0, given[2])
        matrix = pose_matrix(x, y, z, roll, pitch, yaw)
        return matrix @ OPTICAL if optical else matrix

    def _laser(self, message: Any, now: float, stamp: int) -> tuple[Rays, FloatArray]:
        scan = laser_rays(message)
        if scan is None:
            raise DecodingError("its angles or limits are invalid, or it has no rays or too many")
        first, step, ranges, nearest, farthest = scan
        matrix = self._mount(message.header.frame_id, now, stamp)
        angles = first + step * np.arange(len(ranges))
        hit = (ranges >= nearest) & (ranges < farthest)
        ends = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles), np.zeros(len(ranges))])
        body = _moved(matrix, ends)
        excluded = hit & self._excluded(body, now)
        roll, pitch, yaw = roll_pitch_yaw(matrix)
        upside_down = abs(abs(roll) - math.pi) <= _FLAT
        if abs(pitch) > _FLAT or not (upside_down or abs(roll) <= _FLAT):
            return self._reduced(body[hit & ~excluded], matrix, now, excluded=())
        ranges = np.where(excluded, -1.0, ranges)
        sign = -1.0 if upside_down else 1.0
        mount = (float(matrix[0, 3]), float(matrix[1, 3]), yaw)
        rays = Rays(mount, sign * first, sign * step, tuple(ranges.tolist()), nearest, farthest)
        return rays, body[hit & ~excluded][:, :2]

    def _cloud(self, message: Any, now: float, stamp: int) -> tuple[Rays, FloatArray]:
        matrix = self._mount(message.header.frame_id, now, stamp)
        body = _moved(matrix, points_of(message, self.topic.every))
        if self._frames.pose_in(message.header.frame_id) is not None:
            matrix = np.eye(4)  # points in a frame of the world: the sensor's own position is not known
        return self._reduced(body, matrix, now, excluded=self._areas)

    def _depth(self, message: Any, now: float, stamp: int) -> tuple[Rays, FloatArray]:
        if self.camera is None:
            raise DecodingError(f"no CameraInfo arrived on {self.topic.info} yet")
        matrix = self._mount(message.header.frame_id, now, stamp, optical=True)
        body = _moved(matrix, points_of_depth(depth_of(message), self.camera, self.topic.every))
        half = max(self.camera.cx, self.camera.columns - self.camera.cx) / self.camera.fx
        ahead = matrix[:3, 2]
        if math.hypot(ahead[0], ahead[1]) < 0.5:
            raise DecodingError("its camera looks at the ground or the sky: no direction in the plane")
        yaw = math.atan2(ahead[1], ahead[0])
        view = min(2.0 * math.atan(half) + 0.1, 2.0 * math.pi)
        return self._reduced(body, matrix, now, excluded=self._areas, yaw=yaw, view=view)

    def _range(self, message: Any, now: float, stamp: int) -> tuple[Rays, FloatArray]:
        cone = cone_of(message)
        matrix = self._mount(message.header.frame_id, now, stamp)
        roll, pitch, yaw = roll_pitch_yaw(matrix)
        del roll  # a cone is the same however it is rolled
        if abs(pitch) > 0.3:
            raise DecodingError(f"its sensor is tilted by {math.degrees(pitch):.0f} degrees, wanted it level")
        mount = (float(matrix[0, 3]), float(matrix[1, 3]), yaw)
        count = max(2, math.ceil(cone.field_of_view / _ARC_STEP) + 1)
        angles = yaw + np.linspace(-0.5, 0.5, count) * cone.field_of_view
        arc = np.empty((0, 3))
        if cone.nearest <= cone.distance < cone.farthest:
            along = cone.distance * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])
            arc = along + np.array((mount[0], mount[1], float(matrix[2, 3])))
        inside = self._excluded(arc, now)
        if len(arc) and inside.all():
            raise DecodingError("all of its arc is in an exclusion")
        rays = rays_of_range(cone.distance, cone.field_of_view, mount, cone.nearest, cone.farthest)
        return rays, arc[~inside][:, :2]

    def _grid(self, message: Any, now: float, stamp: int) -> tuple[Rays, FloatArray]:
        grid = grid_of(message)
        matrix = self._frames.of(message.header.frame_id, now, stamp)
        x, y, yaw = grid.origin
        origin = matrix @ pose_matrix(x, y, 0.0, 0.0, 0.0, yaw)
        turned = math.atan2(origin[1, 0], origin[0, 0])
        cells, occupied = grid.cells, self.topic.occupied
        if self.topic.unknown_is_occupied:
            cells = np.where(cells < 0, 100, cells)
        row, column = np.nonzero(cells >= occupied)
        middles = (np.column_stack([column, row]) + 0.5) * grid.resolution
        body = _moved(origin, np.column_stack([middles, np.zeros(len(middles))]))
        near = np.hypot(body[:, 0], body[:, 1]) <= self.topic.farthest
        row, column, body = row[near], column[near], body[near]
        excluded = self._excluded(body, now)
        if excluded.any():
            cells = cells.copy()
            cells[row[excluded], column[excluded]] = -1
        corner = (float(origin[0, 3]), float(origin[1, 3]), turned)
        farthest = min(self.topic.farthest, 15.0)
        rays = rays_of_grid(
            cells, grid.resolution, corner, occupied=occupied, rays=_GRID_RAYS, farthest=farthest
        )  # 720 x 600 steps at most
        return rays, body[~excluded][:, :2]

    def _polygon(self, message: Any, now: float, stamp: int) -> tuple[Rays, FloatArray]:
        """The nearest of all polygons that are known: each counts for the time-out of its source."""
        pose = self._frames.pose_in(self._odometry_frame)
        corners = _moved(self._frames.of(message.header.frame_id, now, stamp), corners_of(message))
        number = int(getattr(message.polygon, "id", 0))
        known = {key: one for key, one in self._polygons.items() if 0.0 <= now - one.arrived <= self.topic.time_out}
        known[number] = _Polygon(now, stamp, corners, pose)
        if len(known) > _MOST_POLYGONS:
            raise DecodingError(f"it is one of {len(known)} polygons, wanted {_MOST_POLYGONS} at most")
        self._polygons = known
        shapes = [_moved_points(one.corners, one.pose, pose) for one in known.values()]
        farthest = self.topic.farthest
        each = [rays_of_polygon(shape[:, :2].tolist(), rays=_GRID_RAYS, farthest=farthest) for shape in shapes]
        ranges = np.min([one.ranges for one in each], axis=0)
        angles = each[0].first_angle + each[0].angle_step * np.arange(_GRID_RAYS)
        ends = ranges[:, np.newaxis] * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(_GRID_RAYS)])
        hit = ranges < farthest
        ranges = np.where(hit & self._excluded(ends, now), -1.0, ranges)
        points = np.vstack([outline_points(shape, self.topic.sampling) for shape in shapes])
        points = points[~self._excluded(points, now) & (np.hypot(points[:, 0], points[:, 1]) < farthest)]
        return replace(each[0], ranges=tuple(ranges.tolist())), points[:, :2]

    def _reduced(
        self,
        body: FloatArray,
        matrix: FloatArray,
        now: float,
        *,
        excluded: Sequence[ExclusionArea],
        yaw: float = 0.0,
        view: float = 2.0 * math.pi,
    ) -> tuple[Rays, FloatArray]:
        """Rays of points (points, 3) in the body frame, and those in the height band.

        A direction whose nearest point is excluded sees nothing, since what is behind it stays unknown.
        """
        mount = (float(matrix[0, 3]), float(matrix[1, 3]), yaw)
        own, several = self.topic, {"field_of_view": view, "rays": self.topic.rays}
        limits = {"nearest": own.nearest, "farthest": own.farthest}
        rays = rays_of_points(body, mount, band=self._band, **several, **limits)  # type: ignore[arg-type]
        away = np.hypot(body[:, 0] - mount[0], body[:, 1] - mount[1])
        counts = (body[:, 2] >= own.height[0]) & (body[:, 2] <= own.height[1])
        counts &= (away >= own.nearest) & (away < own.farthest)
        inside = self._excluded(body, now) if excluded else np.zeros(len(body), dtype=bool)
        if inside.any():
            others = rays_of_points(body[~inside], mount, band=self._band, **several, **limits)  # type: ignore[arg-type]
            hidden = np.array(rays.ranges) < np.array(others.ranges)
            rays = Rays(
                rays.mount, rays.first_angle, rays.angle_step,
                tuple(np.where(hidden, -1.0, rays.ranges).tolist()), rays.nearest, rays.farthest, rays.free,
            )  # fmt: skip
        return rays, body[counts & ~inside][:, :2]

    def _excluded(self, body: FloatArray, now: float) -> BoolArray:
        """Which points (points, 3) in the body frame are in an exclusion of this source."""
        found: BoolArray = np.zeros(len(body), dtype=np.bool_)
        for area in self._areas:
            matrix: FloatArray = np.eye(4)
            if area.frame:
                matrix = np.linalg.inv(self._frames.of(area.frame, now)).astype(np.float64)
            places = _moved(matrix, body)[:, :2]
            inside = (
                polygon_contains(np.array(area.points), places)
                if area.points
                else np.hypot(places[:, 0], places[:, 1]) <= area.radius
            )
            found |= inside & (body[:, 2] >= area.height[0]) & (body[:, 2] <= area.height[1])
        return found


def _moved_points(points: FloatArray, before: Frame | None, now: Frame | None) -> FloatArray:
    """Returns points (points, 2 or more) [m] of the body frame at the pose ``before`` in that at ``now``.

    Points stay where they are if a pose is not known.
    """
    if before is None or now is None or not len(points):
        return points
    (x, y, yaw), (to_x, to_y, to_yaw) = before, now
    turn, away_x, away_y = yaw - to_yaw, x - to_x, y - to_y
    cosine, sine = math.cos(turn), math.sin(turn)
    offset_x = math.cos(to_yaw) * away_x + math.sin(to_yaw) * away_y
    offset_y = math.cos(to_yaw) * away_y - math.sin(to_yaw) * away_x
    px, py = points[:, 0], points[:, 1]
    flat = np.column_stack([offset_x + cosine * px - sine * py, offset_y + sine * px + cosine * py])
    return np.column_stack([flat, points[:, 2:]])


def laser_rays(scan: Any) -> tuple[float, float, FloatArray, float, float] | None:
    """Returns first angle, step [rad], ranges (rays,), lowest and highest range [m] of a LaserScan; None if invalid.

    As in ROS REP 117: inf is no return, -inf too near, NaN no measurement. A finite range below ``range_min``, often 0
    for no return, counts as no measurement; -inf becomes ``range_min``.
    Of more than 1080 rays, neighbours are merged: the nearest return of each group counts.
    """
    first, step = float(scan.angle_min), float(scan.angle_increment)
    nearest, farthest = float(scan.range_min), float(scan.range_max)
    count = len(scan.ranges)
    if not (abs(first) <= _LARGEST_ANGLE and math.isfinite(step) and step and 0.0 <= nearest < farthest <= _FARTHEST):
        return None
    if not 0 < count <= _MOST_RAYS or count * abs(step) > 2.0 * math.pi + 2.0 * abs(step):
        return None
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    nothing = np.isnan(ranges) | (np.isfinite(ranges) & (ranges < nearest))
    clean: FloatArray = np.where(nothing, -1.0, np.clip(ranges, nearest, farthest))
    group = -(-count // _MOST_SENT)
    if group > 1:
        padded = np.full(-(-count // group) * group, math.inf)
        padded[:count] = np.where(clean < 0.0, math.inf, clean)
        least = padded.reshape(-1, group).min(axis=1)
        clean = np.where(np.isfinite(least), least, -1.0)
        first, step = first + 0.5 * (group - 1) * step, group * step
    return first, step, clean, nearest, farthest


def _moved(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """Points (points, 3) after a transform (4, 4)."""
    moved: FloatArray = points @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


@final
class SourceReceiver(Receiver):
    """Receives the messages of one source on the network's thread."""

    def __init__(self, reader: SourceReader, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(clock)
        self.reader, self.topic = reader, reader.topic
        self._waiting: deque[SourceReading] = deque(maxlen=_MOST_WAITING)
        self._last = -math.inf
        self._newest: SourceReading | None = None
        self._guard = threading.Lock()

    def take(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message, on the network's thread."""
        at = self._clock()
        if self.topic.type not in (LASER, RANGE, POLYGON_INSTANCE) and 0.0 <= at - self._last < _SHORTEST_GAP:
            return
        if not self._publishers.accept(attachment, at):
            self._refuse(TWO_PUBLISHERS)
            return
        try:
            message = decode(self.topic.type, data)
            stamp = nanoseconds(message.header.stamp)
            numbered = self.topic.type == POLYGON_INSTANCE  # those of one moment have one stamp
            if self.reader.repeats(message, stamp) if numbered else self._repeats(stamp):
                return
            reading = self.reader.read(message, at)
        except DecodingError as error:
            self._refuse(str(error))
            return
        self._last = at
        with self._guard:
            self._note(stamp, at)
            self._waiting.append(reading)
            self._newest = reading

    def take_info(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a CameraInfo, on the network's thread."""
        del attachment
        try:
            self.reader.camera = pinhole_of(decode("sensor_msgs/msg/CameraInfo", data))
        except DecodingError as error:
            self._refuse(f"its CameraInfo cannot be used: {error}")

    def take_all(self) -> list[SourceReading]:
        """Returns the readings since the last call, oldest first."""
        with self._guard:
            found, self._waiting = list(self._waiting), deque(maxlen=_MOST_WAITING)
        return found

    def newest(self) -> tuple[SourceReading | None, float]:
        """Returns the newest reading, and its age [s] (infinite with two publishers)."""
        with self._guard:
            return self._newest, self._age()
