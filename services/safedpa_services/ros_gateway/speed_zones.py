"""Speed zones: they scale the nominal action down while obstacles are in them.

The filter comes afterwards and is unchanged, so that a zone can make the robot slower, and never less safe. Actions and
counts are those of Nav2's collision monitor (github.com/ros-navigation/navigation2, nav2_collision_monitor): all
components of the velocity are scaled alike, which keeps the curvature.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.perception.zones import polygon_contains
from safedpa.ros.decoding import DecodingError
from safedpa.ros.encoding import decode
from safedpa.ros.graph import Attachment
from safedpa.ros.sensor_messages import POLYGON, corners_of
from safedpa_services.ros_gateway.sensor_tables import SpeedZone, VelocityPolygon

__all__ = ["BOOL", "FLOAT", "Limit", "SpeedZones", "ToggleInput", "ZonePolygon", "ZoneRadius", "scaled", "velocity_of"]

BOOL = "std_msgs/msg/Bool"
FLOAT = "std_msgs/msg/Float32"
_LARGEST_RADIUS = 100.0
"""m"""
_NUMBERS = {"": 0, "stop": 1, "slowdown": 2, "limit": 4}
"""``action_type`` of ``nav2_msgs/CollisionMonitorState``."""

Velocity = tuple[float, float, float]
"""Velocity ahead and to the left [m/s], and turn rate [rad/s]."""


@final
@dataclass(frozen=True)
class Limit:
    """The most restrictive zone of a period: the share of the nominal velocity that remains, and its action and name.

    ``share`` is 1 and the texts are empty if no zone acts.
    """

    share: float = 1.0
    action: str = ""
    zone: str = ""

    @property
    def number(self) -> int:
        """``action_type`` of ``nav2_msgs/CollisionMonitorState``."""
        return _NUMBERS[self.action]


@final
class ToggleInput:
    """A switch (``std_msgs/Bool``) that a topic sets; messages that cannot be read change nothing."""

    def __init__(self, on: bool) -> None:
        self.on = on

    def take(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message, on the network's thread."""
        del attachment
        try:
            self.on = bool(decode(BOOL, data).data)
        except DecodingError:
            return


@final
class ZonePolygon:
    """Corners of a zone that a topic (``geometry_msgs/PolygonStamped``) sets, in the body frame.

    :param to_body: transform (4, 4) from a frame to the body; raises DecodingError
    """

    def __init__(self, to_body: Callable[[str], FloatArray]) -> None:
        self._to_body, self._lock = to_body, threading.Lock()
        self._corners: tuple[str, FloatArray] | None = None
        self.why = "no polygon arrived yet"
        """Why there are no corners; empty if there are."""

    def take(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message, on the network's thread."""
        del attachment
        try:
            message = decode(POLYGON, data)
            corners = corners_of(message)
        except DecodingError as error:
            self.why = str(error)
            return
        with self._lock:
            self._corners, self.why = (message.header.frame_id, corners), ""

    def shape(self) -> FloatArray | None:
        """Returns the corners (corners, 2) [m] in the body frame now; None if they are not known."""
        with self._lock:
            known = self._corners
        if known is None:
            return None
        try:
            matrix = self._to_body(known[0])
        except DecodingError as error:
            self.why = str(error)
            return None
        moved: FloatArray = (known[1] @ matrix[:3, :3].T + matrix[:3, 3])[:, :2]
        return moved


@final
class ZoneRadius:
    """Radius of a zone that a topic (``std_msgs/Float32``) sets [m]; a message that cannot be used leaves none."""

    def __init__(self) -> None:
        self._radius: float | None = None
        self.why = "no radius arrived yet"
        """Why there is no radius; empty if there is one."""

    def take(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message, on the network's thread."""
        del attachment
        try:
            radius = float(decode(FLOAT, data).data)
        except DecodingError as error:
            self._radius, self.why = None, str(error)
            return
        usable = 0.0 < radius <= _LARGEST_RADIUS
        self.why = "" if usable else f"its radius is {radius:g} m, wanted more than 0 and at most {_LARGEST_RADIUS:g}"
        self._radius = radius if usable else None

    def shape(self) -> float | None:
        """Returns the radius [m]; None if it is not known."""
        return self._radius


@dataclass
class _Counts:
    hits: int = 0
    misses: int = 0
    active: bool = False


@final
class SpeedZones:
    """The zones of one robot; ``limit`` is called once in each period.

    Example:

        >>> import numpy as np
        >>> from safedpa_services.ros_gateway.sensor_tables import SpeedZone
        >>> from safedpa_services.ros_gateway.speed_zones import SpeedZones
        >>> square = ((0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5))
        >>> zones = SpeedZones((SpeedZone("near", "slowdown", square, min_points=1, ratio=0.3),))
        >>> zones.limit((0.4, 0.0, 0.0), {"laser": np.array([[0.3, 0.1]])}).share
        0.3
    """

    def __init__(
        self,
        zones: Sequence[SpeedZone],
        shapes: Mapping[str, ZonePolygon | ZoneRadius] | None = None,
        switches: Mapping[str, ToggleInput] | None = None,
        all_on: ToggleInput | None = None,
    ) -> None:
        self._zones, self._shapes = tuple(zones), shapes or {}
        self._switches = switches or {zone.name: ToggleInput(zone.enabled) for zone in zones}
        self._all_on = all_on or ToggleInput(True)
        self._counts = {zone.name: _Counts() for zone in zones}

    def limit(self, nominal: Velocity, points: Mapping[str, FloatArray]) -> Limit:
        """Returns the limit for a nominal velocity; ``points`` are (points, 2) [m] in the body frame, by source.

        A zone without a shape stops the robot, because it is not known what is in it.
        """
        best = Limit()
        for zone in self._zones:
            counts = self._counts[zone.name]
            if not self._all_on.on or not self._switches[zone.name].on:
                self._counts[zone.name] = _Counts()
                continue
            shape = self._shape(zone, nominal)
            if shape is None:
                return Limit(0.0, "stop", zone.name)
            inside = sum(_inside(shape, points[name]) for name in zone.sources or tuple(points) if name in points)
            if self._acts(zone, counts, inside):
                found = Limit(_share(zone, nominal), zone.action, zone.name)
                best = min(best, found, key=lambda one: one.share)
        return best

    def missing(self) -> str:
        """Returns why a zone has no shape; empty if all have one."""
        for name, one in self._shapes.items():
            if one.shape() is None:
                return f"the zone {name} has no shape: {one.why}"
        return ""

    def _shape(self, zone: SpeedZone, nominal: Velocity) -> FloatArray | float | None:
        if zone.radius:
            return zone.radius
        if zone.topic or zone.radius_topic:
            return self._shapes[zone.name].shape()
        if zone.velocity:
            matching = (part for part in zone.velocity if _matches(part, nominal, holonomic=zone.holonomic))
            return np.array(next(matching, zone.velocity[-1]).points)
        return np.array(zone.points)

    @staticmethod
    def _acts(zone: SpeedZone, counts: _Counts, inside: int) -> bool:
        if inside >= zone.min_points:
            counts.hits, counts.misses = counts.hits + 1, 0
            counts.active = counts.active or counts.hits >= zone.trigger_after
        else:
            counts.hits, counts.misses = 0, counts.misses + 1
            counts.active = counts.active and counts.misses < zone.release_after
        return counts.active


def _inside(shape: FloatArray | float, points: FloatArray) -> int:
    if not len(points):
        return 0
    if isinstance(shape, float):
        return int((np.hypot(points[:, 0], points[:, 1]) <= shape).sum())
    return int(polygon_contains(shape, points).sum())


def _matches(part: VelocityPolygon, nominal: Velocity, *, holonomic: bool) -> bool:
    ahead, aside, turn = nominal
    if not part.angular[0] <= turn <= part.angular[1]:
        return False
    if not holonomic:
        return part.linear[0] <= ahead <= part.linear[1]
    speed = math.hypot(ahead, aside)
    direction, (first, last) = math.atan2(aside, ahead) if speed else 0.0, part.direction
    within = first <= direction <= last if first <= last else direction >= first or direction <= last
    return within and part.linear[0] <= speed <= part.linear[1]


def _share(zone: SpeedZone, nominal: Velocity) -> float:
    if zone.action == "stop":
        return 0.0
    if zone.action == "slowdown":
        return zone.ratio
    speed, turn = math.hypot(nominal[0], nominal[1]), abs(nominal[2])
    return min(1.0, zone.linear / speed if speed else 1.0, zone.angular / turn if turn else 1.0)


def scaled(numbers: Sequence[float], paths: Sequence[str], share: float) -> tuple[float, ...]:
    """Returns the fields of a command with every velocity multiplied by ``share``; steering angles stay."""
    keeps = ("steering_angle",)
    return tuple(
        value if path.rpartition(".")[2] in keeps else share * value for value, path in zip(numbers, paths, strict=True)
    )


def velocity_of(values: Mapping[str, Any]) -> Velocity:
    """Returns the velocity in the fields of a Twist."""
    linear, angular = values.get("linear", {}), values.get("angular", {})
    return float(linear.get("x", 0.0)), float(linear.get("y", 0.0)), float(angular.get("z", 0.0))
