"""Tables of the robot file about sensors other than ``[[scans]]``, speed zones, frames and clocks, and their checks."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from safedpa.errors import InputError, did_you_mean
from safedpa.ros.sensor_messages import CLOUD, COSTMAP, DEPTH_IMAGE, GRID, POLYGON, POLYGON_INSTANCE, RANGE

__all__ = [
    "LASER",
    "ClockTopic",
    "ExclusionArea",
    "FootprintTopic",
    "FrameTopics",
    "MonitorTopics",
    "SourceTopic",
    "SpeedZone",
    "VelocityPolygon",
    "check_sensor_tables",
    "perception_text",
]

LASER = "sensor_msgs/msg/LaserScan"
SOURCE_TYPES = (LASER, CLOUD, DEPTH_IMAGE, RANGE, GRID, COSTMAP, POLYGON, POLYGON_INSTANCE)
_FRAMED = (GRID, COSTMAP, POLYGON, POLYGON_INSTANCE)
"""Types whose messages name the frame of their contents, so that they have no mount."""
ACTIONS = ("stop", "slowdown", "limit")
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,40}")
_WIDEST = 100.0
"""m; largest coordinate of a zone or a mount."""
_LONGEST_TIME_OUT = 1.0
"""s; the filter accepts no older surroundings."""
_MOST_SOURCES, _MOST_ZONES, _MOST_CORNERS = 16, 32, 64


@dataclass(frozen=True)
class SourceTopic:
    """A sensor of any type that perception can use."""

    topic: str
    type: str = LASER
    name: str = "source"
    frame: str = ""
    """Frame of its messages; others are refused. Empty: any."""
    mount: tuple[float, ...] = ()
    """Pose in the body frame: x, y, yaw or x, y, z, roll, pitch, yaw [m, rad]. Empty: from tf. A camera looks along
    x. Grids and polygons have no mount."""
    delay: float = 0.0
    """Time from the measurement to the arrival of its message [s]."""
    time_out: float = 0.5
    """Largest time without a message [s]; the robot brakes after it."""
    height: tuple[float, ...] = (0.05, 0.5)
    """Lowest and highest point that is an obstacle [m above the ground]; of clouds and depth images."""
    every: int = 1
    """Of clouds every n-th point is used, of depth images every n-th row and column."""
    rays: int = 360
    """Directions to which the points are reduced."""
    nearest: float = 0.05
    farthest: float = 12.0
    """Distance [m] below and above which a point is not used."""
    info: str = ""
    """Topic of the CameraInfo of a depth image."""
    occupied: int = 100
    """Cost from which a cell of a grid is an obstacle: 0 to 100, as in ``nav_msgs/OccupancyGrid``."""
    sampling: float = 0.1
    """Largest distance [m] between the points of a polygon's outline that count in the speed zones."""
    unknown_is_occupied: bool = False
    """Whether a cell without information is an obstacle; otherwise something may hide in it."""
    enabled: bool = True
    """Whether it counts in the speed zones."""
    enable: str = ""
    """Topic (``std_msgs/Bool``) that sets ``enabled``. The filter always uses the source."""
    exclusions: tuple[str, ...] = ()
    """Names of the ``[[exclusions]]`` in which its points are not used."""


@dataclass(frozen=True)
class ExclusionArea:
    """An area whose points the sources that name it do not report: nothing is protected there."""

    name: str
    points: tuple[tuple[float, ...], ...] = ()
    """Corners of a polygon [m] in ``frame``; or a circle of ``radius``."""
    radius: float = 0.0
    frame: str = ""
    """Frame of the area; empty: the body frame. Other frames need tf."""
    height: tuple[float, ...] = (-1e3, 1e3)
    """Band of heights in the body frame [m] to which it is limited."""
    enabled: bool = True
    """Whether it applies."""
    enable: str = ""
    """Topic (``std_msgs/Bool``) that sets ``enabled``."""


@dataclass(frozen=True)
class VelocityPolygon:
    """A polygon of a zone for a range of nominal velocities."""

    points: tuple[tuple[float, ...], ...]
    linear: tuple[float, ...]
    """Lowest and highest velocity ahead [m/s]; of a holonomic zone the speed."""
    angular: tuple[float, ...]
    """Lowest and highest turn rate [rad/s]."""
    direction: tuple[float, ...] = (-math.pi, math.pi)
    """First and last direction of motion [rad], of a holonomic zone."""


@dataclass(frozen=True)
class SpeedZone:
    """A zone around the robot that limits the nominal action while obstacles are in it; the filter acts on the rest."""

    name: str
    action: str
    """``stop``, ``slowdown`` (by ``ratio``) or ``limit`` (to ``linear`` and ``angular``)."""
    points: tuple[tuple[float, ...], ...] = ()
    """Corners in the body frame [m]; or a circle of ``radius``; or a topic; or ``velocity``."""
    radius: float = 0.0
    radius_topic: str = ""
    """Topic (``std_msgs/Float32``) of the radius [m]."""
    topic: str = ""
    """Topic (``geometry_msgs/PolygonStamped``) of the corners."""
    velocity: tuple[VelocityPolygon, ...] = ()
    """Polygons by nominal velocity. The first that matches counts; if none does, the last."""
    holonomic: bool = False
    min_points: int = 4
    """Points of all its sources that must be inside."""
    ratio: float = 0.5
    linear: float = 0.5
    """m/s."""
    angular: float = 0.5
    """rad/s."""
    sources: tuple[str, ...] = ()
    """Names of the sources that count; empty: all."""
    trigger_after: int = 1
    release_after: int = 1
    """Consecutive periods with and without enough points until the zone acts and stops acting."""
    enabled: bool = True
    enable: str = ""
    """Topic (``std_msgs/Bool``) that sets ``enabled``."""


@dataclass(frozen=True)
class MonitorTopics:
    """Topics about all zones."""

    state: str = ""
    """Topic for ``nav2_msgs/CollisionMonitorState``, published when the acting zone changes."""
    enable: str = ""
    """Topic (``std_msgs/Bool``) that switches all zones on and off."""


@dataclass(frozen=True)
class FrameTopics:
    """Where transforms are received, if a source takes its mount from tf."""

    fixed: str = "/tf_static"
    moving: str = "/tf"
    base: str = "base_link"
    """Body frame, with its origin on the ground at the odometry's point (``odometry.ahead``)."""
    largest_age: float = 0.5
    """Largest age [s] of a moving link between a sensor and the body; the robot brakes if there is no newer one."""


@dataclass(frozen=True)
class FootprintTopic:
    """The robot's footprint, a ``geometry_msgs/PolygonStamped``, in place of ``surroundings.footprint``."""

    topic: str = ""
    largest_age: float = 2.0
    """Largest age [s]; the robot brakes if there is no newer message."""
    hold: float = 2.0
    """Time [s] for which the largest extent counts, because a footprint in the odometry's frame is noisy."""


@dataclass(frozen=True)
class ClockTopic:
    """Simulated time, ``rosgraph_msgs/Clock``: periods and ages then follow it."""

    topic: str = ""
    largest_gap: float = 0.5
    """Time [s] without a message after which simulated time counts as stopped, and the robot brakes."""


def check_sensor_tables(
    sources: Sequence[SourceTopic],
    exclusions: Sequence[ExclusionArea],
    zones: Sequence[SpeedZone],
    frames: FrameTopics,
    ages: Sequence[tuple[str, float]],
) -> None:
    """Raises InputError naming the key if the tables are inconsistent."""
    for what, names, most in (
        ("sources", [one.name for one in sources], _MOST_SOURCES),
        ("exclusions", [one.name for one in exclusions], _MOST_ZONES),
        ("zones", [one.name for one in zones], _MOST_ZONES),
    ):
        if len(names) > most:
            raise InputError(f"{what}: got {len(names)}, wanted {most} at most")
        for name in names:
            if not _NAME.fullmatch(name) or names.count(name) > 1:
                raise InputError(
                    f"{what}.name: got '{name}'{' twice' if names.count(name) > 1 else ''}, wanted a different name "
                    "for each, of letters, digits, '-', '_' or '.', at most 40"
                )
    for source in sources:
        _check_source(source, [one.name for one in exclusions])
    for area in exclusions:
        _check_shape(f"exclusions '{area.name}'", area.points, area.radius, bool(area.points or area.radius))
        _check_range(f"exclusions '{area.name}': height", area.height, 1e4)
    for zone in zones:
        _check_zone(zone, [one.name for one in sources])
    for key, value in [*ages, ("frames.largest_age", frames.largest_age)]:
        if not 0.0 < value <= 10.0:
            raise InputError(f"{key}: got {value:g}, wanted more than 0 and at most 10 s")


def perception_text(sensors: Sequence[SourceTopic]) -> str:
    """Returns the settings of perception (TOML) for these sensors: their time-outs, and whether they repeat themselves.

    Example:

        >>> from safedpa_services.ros_gateway.sensor_tables import SourceTopic, perception_text
        >>> print(perception_text([SourceTopic("/sonar", "sensor_msgs/msg/Range", "sonar", time_out=0.3)]), end="")
        [sources."sonar"]
        time_out = 0.3
        repeats = true
    """
    lines = []
    for one in sensors:
        repeats = one.type in (RANGE, *_FRAMED)
        lines += [f'[sources."{one.name}"]', f"time_out = {one.time_out}", f"repeats = {str(repeats).lower()}"]
    return "\n".join(lines) + "\n"


def _check_source(source: SourceTopic, areas: Sequence[str]) -> None:
    key = f"sources '{source.name}'"
    if source.type not in SOURCE_TYPES:
        raise InputError(f"{key}: type: got '{source.type}'; {did_you_mean(source.type, SOURCE_TYPES)}")
    if len(source.mount) not in (0, 3, 6) or any(abs(value) > _WIDEST for value in source.mount):
        raise InputError(
            f"{key}: mount: got {list(source.mount)}, wanted x, y, yaw or x, y, z, roll, pitch, yaw in m and rad, "
            "or none for the pose from tf"
        )
    if source.mount and source.type in _FRAMED:
        raise InputError(f"{key}: mount: got one for a {source.type}, wanted none: its messages name its frame")
    if bool(source.info) != (source.type == DEPTH_IMAGE):
        raise InputError(
            f"{key}: info: got '{source.info}', wanted the topic of CameraInfo of a depth image, else none"
        )
    for name, value, low, high in (
        ("delay", source.delay, 0.0, 0.5),
        ("time_out", source.time_out, 0.05, _LONGEST_TIME_OUT),
        ("every", source.every, 1, 64),
        ("rays", source.rays, 16, 1080),
        ("nearest", source.nearest, 0.0, 10.0),
        ("farthest", source.farthest, source.nearest + 0.1, 100.0),
        ("occupied", source.occupied, 1, 100),
        ("sampling", source.sampling, 0.01, 10.0),
    ):
        if not low <= value <= high:
            raise InputError(f"{key}: {name}: got {value:g}, wanted {low:g} to {high:g}")
    _check_range(f"{key}: height", source.height, _WIDEST)
    for name in source.exclusions:
        if name not in areas:
            raise InputError(f"{key}: exclusions: got '{name}'; {did_you_mean(name, areas)}")


def _check_zone(zone: SpeedZone, sources: Sequence[str]) -> None:
    key = f"zones '{zone.name}'"
    if zone.action not in ACTIONS:
        raise InputError(f"{key}: action: got '{zone.action}'; {did_you_mean(zone.action, ACTIONS)}")
    topic = bool(zone.topic or zone.radius_topic)
    shapes = [bool(one) for one in (zone.points, zone.radius, zone.topic, zone.radius_topic, zone.velocity)]
    if sum(shapes) != 1:
        raise InputError(
            f"{key}: got {sum(shapes)} of points, radius, topic, radius_topic and velocity, wanted one of them"
        )
    _check_shape(key, zone.points, zone.radius, not topic and not zone.velocity)
    for part in zone.velocity:
        _check_shape(f"{key}: velocity", part.points, 0.0, True)
        _check_range(f"{key}: velocity.linear", part.linear, _WIDEST)
        _check_range(f"{key}: velocity.angular", part.angular, _WIDEST)
        if len(part.direction) != 2:
            raise InputError(f"{key}: velocity.direction: got {list(part.direction)}, wanted first and last in rad")
    for name, value, low, high in (
        ("min_points", zone.min_points, 1, 100_000),
        ("ratio", zone.ratio, 0.0, 1.0),
        ("linear", zone.linear, 0.0, _WIDEST),
        ("angular", zone.angular, 0.0, _WIDEST),
        ("trigger_after", zone.trigger_after, 1, 1000),
        ("release_after", zone.release_after, 1, 1000),
    ):
        if not low <= value <= high:
            raise InputError(f"{key}: {name}: got {value:g}, wanted {low:g} to {high:g}")
    for name in zone.sources:
        if name not in sources:
            raise InputError(f"{key}: sources: got '{name}'; {did_you_mean(name, sources)}")


def _check_range(key: str, values: Sequence[float], largest: float) -> None:
    if len(values) != 2 or not -largest <= values[0] < values[1] <= largest:
        raise InputError(f"{key}: got {list(values)}, wanted the lowest and the highest, at most {largest:g}")


def _check_shape(key: str, points: Sequence[Sequence[float]], radius: float, wanted: bool) -> None:
    if not wanted:
        return
    if points and (not 3 <= len(points) <= _MOST_CORNERS or any(len(one) != 2 for one in points)):
        raise InputError(f"{key}: points: got {len(points)} corners, wanted 3 to {_MOST_CORNERS} of x and y in m")
    if any(abs(value) > _WIDEST for one in points for value in one) or not 0.0 <= radius <= _WIDEST:
        raise InputError(f"{key}: got a corner or radius beyond {_WIDEST:g} m, wanted metres")
    if not points and not radius:
        raise InputError(f"{key}: got no shape, wanted points or a radius above 0")
