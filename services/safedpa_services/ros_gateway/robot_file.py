"""The robot file ``robot.toml``: kind of robot, ROS connection, topics, surroundings.

Errors name the key. They are raised before the gateway joins the bus or moves the robot.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, get_args, get_type_hints

from safedpa.bus import STATE, key_of
from safedpa.errors import InputError, did_you_mean
from safedpa.limits import finite_number, parse_toml, text_of_file, whole_number
from safedpa.ros.graph import NO_HASH
from safedpa.ros.link import FORMS
from safedpa.runtime.scene import MOST_OBSTACLES
from safedpa.systems.robots import robot_named
from safedpa_services.ros_gateway.sensor_tables import (
    LASER,
    ClockTopic,
    ExclusionArea,
    FootprintTopic,
    FrameTopics,
    MonitorTopics,
    SourceTopic,
    SpeedZone,
    check_sensor_tables,
)

FORMAT = 2


@dataclass(frozen=True)
class RosConnection:
    """The robot's Zenoh router, and the encoding of ROS topics in Zenoh."""

    endpoint: str = "tcp/127.0.0.1:7447"
    domain: int = 0
    form: str = "rmw_zenoh"
    """``rmw_zenoh``, or ``bridge`` for zenoh-bridge-ros2dds."""
    diagnostics: str = "/diagnostics"
    """Topic for verdicts; empty: not published."""
    markers: str = "/safedpa/markers"
    """Topic for markers of the predicted path; empty: not published."""
    frame: str = "odom"


@dataclass(frozen=True)
class OdometryTopic:
    """The robot's odometry."""

    topic: str
    type: str = "nav_msgs/msg/Odometry"
    ahead: float = 0.0
    """Distance from the robot's reference point (of a car the rear axle) to the odometry's point [m]."""
    largest_age: float = 0.1
    """Largest age [s]; the robot brakes if there is no newer message."""


@dataclass(frozen=True)
class NominalActionTopic:
    """Nominal actions of the robot's own policy, which go through the filter."""

    topic: str = ""
    """Empty: the nominal actions come from a policy on the bus (``safedpa serve --policy``)."""
    type: str = ""
    """Message type; empty: that of the command."""
    largest_age: float = 0.5


@dataclass(frozen=True)
class CommandTopic:
    """Commands to the robot's driver. No other node may publish there."""

    topic: str
    type: str = ""
    """Message type; empty: the default of this robot."""
    hash: str = ""
    """Type hash; empty: taken from the driver's liveliness token, else computed."""


@dataclass(frozen=True)
class GoalTopic:
    """Goal for a policy on the bus, a ``geometry_msgs/PoseStamped``."""

    topic: str = ""


@dataclass(frozen=True)
class LocalisationTopic:
    """Transforms from the map to the odometry's frame, which correct the odometry's drift."""

    topic: str = ""
    frame: str = "map"
    """Frame of the map; surroundings and goal are then in this frame."""
    largest_age: float = 1.0
    """Largest age [s]; the robot brakes if there is no newer message."""


@dataclass(frozen=True)
class ConfirmationTopic:
    """Poses that confirm an implausible state, ``geometry_msgs/PoseWithCovarianceStamped`` in the map's frame.

    Such as a person's estimate in RViz (``/initialpose``), or a localisation that does not depend on the odometry.
    """

    topic: str = ""
    distance: float = 0.3
    """Largest distance [m] between such a pose and that of the state."""
    angle: float = 0.3
    """The same for the heading [rad]."""


@dataclass(frozen=True)
class ScanTopic:
    """A laser scanner, ``sensor_msgs/LaserScan``. With a scanner, perception detects obstacles; none are given here."""

    topic: str
    name: str = "laser"
    frame: str = ""
    """Frame of its messages; others are refused. Empty: any."""
    mount: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Position x ahead and y to the left of the robot's reference point [m], and yaw of its angle 0 [rad]."""
    delay: float = 0.0
    """Time from the middle of a scan to the arrival of its message [s]."""


@dataclass(frozen=True)
class ObstaclesTopic:
    """Static surroundings, in the frame of the odometry or the map."""

    field: tuple[float, ...]
    """Lowest x, highest x, lowest y, highest y [m]."""
    footprint: tuple[float, ...]
    """Extent behind and ahead of the robot's reference point, and its radius [m]."""
    obstacles: tuple[tuple[float, ...], ...] = ()
    """x, y, radius [m] of each obstacle."""
    goal: tuple[float, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ServedRobot:
    """A robot that the services are for."""

    robot: str
    name: str = "r1"
    model: str = ""
    """Model file, or the name of a shipped one; empty: the robot's default."""
    settings: str = ""
    margin: str = ""
    rate: float = 0.0
    """Ticks per second; 0: the robot's default."""


@dataclass(frozen=True, kw_only=True)
class RobotFile(ServedRobot):
    """A robot that uses ROS 2."""

    odometry: OdometryTopic
    command: CommandTopic
    surroundings: ObstaclesTopic
    nominal: NominalActionTopic = field(default_factory=NominalActionTopic)
    goal: GoalTopic = field(default_factory=GoalTopic)
    localisation: LocalisationTopic = field(default_factory=LocalisationTopic)
    confirmation: ConfirmationTopic = field(default_factory=ConfirmationTopic)
    scans: tuple[ScanTopic, ...] = ()
    sources: tuple[SourceTopic, ...] = ()
    exclusions: tuple[ExclusionArea, ...] = ()
    zones: tuple[SpeedZone, ...] = ()
    monitor: MonitorTopics = field(default_factory=MonitorTopics)
    frames: FrameTopics = field(default_factory=FrameTopics)
    footprint: FootprintTopic = field(default_factory=FootprintTopic)
    clock: ClockTopic = field(default_factory=ClockTopic)
    wire: RosConnection = field(default_factory=RosConnection)

    @property
    def frame(self) -> str:
        """Frame of pose, goal and surroundings."""
        return self.localisation.frame if self.localisation.topic else self.wire.frame

    @property
    def sensors(self) -> tuple[SourceTopic, ...]:
        """All sources: those of ``[[scans]]``, then those of ``[[sources]]``."""
        scans = (SourceTopic(one.topic, LASER, one.name, one.frame, one.mount, one.delay) for one in self.scans)
        return (*scans, *self.sources)


def load_robot_file(path: Path) -> RobotFile:
    """Loads the file of a ROS 2 robot. Raises InputError naming file and key."""
    found = _loaded(path, lambda table: RobotFile)
    assert isinstance(found, RobotFile)
    return found


def load_served_robot(path: Path) -> ServedRobot:
    """Loads the file of any robot; returns a RobotFile if it has keys for ROS.

    Raises InputError naming file and key.
    """
    own = {item.name for item in fields(RobotFile)} - {item.name for item in fields(ServedRobot)}
    return _loaded(path, lambda table: RobotFile if own & table.keys() else ServedRobot)


def uses_transforms(robot_file: RobotFile) -> bool:
    """Whether a source, exclusion, zone or footprint may need the pose of a frame from tf."""
    return bool(
        any(not one.mount for one in robot_file.sensors)
        or any(one.frame for one in robot_file.exclusions)
        or any(one.topic for one in robot_file.zones)
        or robot_file.footprint.topic
    )


def parse_robot_file(text: str) -> RobotFile:
    """Parses the TOML text of a ROS 2 robot. Raises InputError naming the key."""
    found = _parsed(text, lambda table: RobotFile)
    assert isinstance(found, RobotFile)
    return found


def _parsed(text: str, kind_of: Callable[[Mapping[str, Any]], type[ServedRobot]]) -> ServedRobot:
    table = parse_toml(text)
    if table.pop("format", None) != FORMAT:
        raise InputError(f"format: wanted {FORMAT}; convert an earlier file with 'safedpa migrate'")
    found: ServedRobot = _of(kind_of(table), table, "")
    check_served(found)
    if isinstance(found, RobotFile):
        check_robot_file(found)
    return found


def _loaded(path: Path, kind_of: Callable[[Mapping[str, Any]], type[ServedRobot]]) -> ServedRobot:
    try:
        return _parsed(text_of_file(path, "toml_bytes"), kind_of)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', error)})") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _of(kind: Any, table: Mapping[str, Any], prefix: str) -> Any:
    hints = get_type_hints(kind)
    known = {item.name: item for item in fields(kind)}
    for key in table:
        if key not in known:
            raise InputError(f"{prefix}{key}: unknown key; {did_you_mean(key, known)}")
    given = {}
    for name, item in known.items():
        if name in table:
            given[name] = _value(hints[name], table[name], f"{prefix}{name}")
        elif item.default is MISSING and item.default_factory is MISSING:
            raise InputError(f"{prefix}{name}: missing; docs/guides/ros.md has a complete file")
    return kind(**given)


def _value(kind: Any, value: Any, key: str) -> Any:
    if hasattr(kind, "__dataclass_fields__"):
        if not isinstance(value, dict):
            raise InputError(f"{key}: got {value!r}, wanted a table [{key}]")
        return _of(kind, value, f"{key}.")
    if kind is str:
        if not isinstance(value, str):
            raise InputError(f"{key}: got {value!r}, wanted a string")
        return value
    if kind is bool:
        if not isinstance(value, bool):
            raise InputError(f"{key}: got {value!r}, wanted true or false")
        return value
    if kind in (float, int):
        return finite_number(key, value) if kind is float else whole_number(key, value)
    inner = get_args(kind)[0]
    if not isinstance(value, list):
        kinds = "texts" if inner is str else "numbers"
        wanted = f"tables [[{key}]]" if hasattr(inner, "__dataclass_fields__") else f"a list of {kinds}"
        raise InputError(f"{key}: got {value!r}, wanted {wanted}")
    return tuple(_value(inner, one, key) for one in value)


_TOPIC = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
"""A ROS topic name without substitutions (design.ros2.org/articles/topic_and_service_names.html)."""
_HASH = re.compile(rf"RIHS01_[0-9a-f]{{64}}|{NO_HASH}")
_LARGEST = 1e4
"""Largest coordinate [m]."""
_WIDEST = 100.0
_ODOMETRY = "nav_msgs/msg/Odometry"


def check_served(found: ServedRobot) -> None:
    """Raises InputError for an invalid name, an unknown kind of robot, or an invalid rate."""
    robot_named(found.robot)
    try:
        key_of("fleet", found.name, STATE)
    except InputError as error:
        raise InputError(f"name: {str(error).removeprefix('name ')}") from error
    if found.rate and not 1.0 <= found.rate <= 500.0:
        raise InputError(f"rate: got {found.rate}, wanted 1 to 500 ticks per second, or 0 for the robot's default")


def check_robot_file(found: RobotFile) -> None:
    """Raises InputError naming the key if the file is inconsistent."""
    _check_surroundings(found.surroundings)
    _check_wire(found)
    _check_ages(found)
    _check_topics(found)
    for scan in found.scans:
        _check_scan(scan)
    names = [scan.name for scan in found.scans]
    if len({*names}) < len(names):
        raise InputError(f"scans.name: got {', '.join(names)}, wanted a different name for each scanner")
    ages = [("footprint.largest_age", found.footprint.largest_age), ("footprint.hold", found.footprint.hold)]
    ages.append(("clock.largest_gap", found.clock.largest_gap))
    check_sensor_tables(found.sensors, found.exclusions, found.zones, found.frames, ages)
    if found.sensors and found.surroundings.obstacles:
        table = "[[scans]]" if found.scans else "[[sources]]"
        raise InputError(
            f"surroundings.obstacles: got some together with {table}, wanted none: perception detects obstacles"
        )
    if found.zones and not found.nominal.topic:
        raise InputError(
            "zones: got some without [nominal], wanted the topic of the robot's own policy: they limit its actions"
        )
    if found.zones and not found.sensors:
        raise InputError("zones: got some without [[sources]], wanted the sensors whose points they count")


def _check_surroundings(around: ObstaclesTopic) -> None:
    for key, values, count in (("field", around.field, 4), ("footprint", around.footprint, 3)):
        if len(values) != count:
            raise InputError(f"surroundings.{key}: got {len(values)} numbers, wanted {count}")
        if max(map(abs, values)) > _LARGEST:
            raise InputError(f"surroundings.{key}: got {list(values)}, wanted at most {_LARGEST:g} m")
    west, east, south, north = around.field
    rear, front, radius = around.footprint
    if not 0.0 < radius <= _WIDEST or not -front <= rear <= _WIDEST or front > _WIDEST:
        raise InputError(
            f"surroundings.footprint: got {list(around.footprint)}, wanted the extents behind and ahead of the "
            f"reference point, with a sum of 0 or more, and a radius above 0; at most {_WIDEST:g} m each"
        )
    if east - west <= 2.0 * radius or north - south <= 2.0 * radius:
        raise InputError(
            f"surroundings.field: got {list(around.field)}, wanted lowest x, highest x, lowest y, highest y in m, with "
            f"room for a robot of {2.0 * radius:g} m width"
        )
    if len(around.obstacles) > MOST_OBSTACLES:
        raise InputError(f"surroundings.obstacles: got {len(around.obstacles)}, wanted at most {MOST_OBSTACLES}")
    if any(len(one) != 3 or not 0.0 < one[2] <= _LARGEST for one in around.obstacles):
        raise InputError("surroundings.obstacles: wanted x, y and a radius above 0 for each")
    if around.goal and not (len(around.goal) == 2 and west < around.goal[0] < east and south < around.goal[1] < north):
        raise InputError(f"surroundings.goal: got {list(around.goal)}, wanted x and y within the field, or none")


def _check_wire(found: RobotFile) -> None:
    wire = found.wire
    if wire.form not in FORMS:
        raise InputError(f"wire.form: got '{wire.form}', wanted {' or '.join(FORMS)}")
    if not 0 <= wire.domain <= 232:
        raise InputError(f"wire.domain: got {wire.domain}, wanted 0 to 232")
    if not re.fullmatch(r"[a-z-]+/[^\s#?]+", wire.endpoint):
        raise InputError(f"wire.endpoint: got '{wire.endpoint}', wanted an endpoint such as tcp/robot:7447")


def _check_ages(found: RobotFile) -> None:
    ages = [("odometry", found.odometry.largest_age), ("nominal", found.nominal.largest_age)]
    for key, age in [*ages, ("localisation", found.localisation.largest_age)]:
        if not 0.0 < age <= 2.0:
            raise InputError(f"{key}.largest_age: got {age}, wanted more than 0 and at most 2 s")
    for key, most in (("distance", 1.0), ("angle", 1.0)):
        if not 0.0 < getattr(found.confirmation, key) <= most:
            got = getattr(found.confirmation, key)
            raise InputError(f"confirmation.{key}: got {got}, wanted more than 0 and at most {most:g}")
    if not abs(found.odometry.ahead) <= _WIDEST:
        raise InputError(f"odometry.ahead: got {found.odometry.ahead}, wanted at most {_WIDEST:g} m")
    if found.odometry.type not in (_ODOMETRY, _ODOMETRY.replace("/msg", "")):
        raise InputError(f"odometry.type: got '{found.odometry.type}', wanted {_ODOMETRY}")


def _check_topics(found: RobotFile) -> None:
    topics = {
        "odometry": found.odometry.topic,
        "command": found.command.topic,
        "nominal": found.nominal.topic,
        "goal": found.goal.topic,
        "localisation": found.localisation.topic,
    }
    published = {
        "wire.diagnostics": found.wire.diagnostics,
        "wire.markers": found.wire.markers,
        "monitor.state": found.monitor.state,
    }
    received = [*topics.items(), *(("scans", scan.topic) for scan in found.scans)]
    required = ("odometry.topic", "command.topic", "scans.topic", "sources.topic")
    for key, topic in [*((f"{key}.topic", topic) for key, topic in received), *_more_topics(found), *published.items()]:
        if not _TOPIC.fullmatch(topic) and (topic or key in required):
            raise InputError(f"{key}: got '{topic}', wanted a topic such as /odom: letters, digits, '_' and '/'")
    for key, topic in published.items():  # over a bridge, the driver would interpret such a message as a command
        if topic.strip("/") == found.command.topic.strip("/"):
            raise InputError(
                f"{key}: got '{topic}', the topic of the command, which the driver obeys; choose another topic"
            )
    if found.nominal.topic.strip("/") == found.command.topic.strip("/"):
        raise InputError(
            f"nominal.topic: got '{found.command.topic}', the topic of the command, past the filter; let the policy "
            "publish to another one, such as drive_in"
        )
    if found.localisation.topic and found.localisation.frame.strip("/") in ("", found.wire.frame.strip("/")):
        raise InputError(
            f"localisation.frame: got '{found.localisation.frame}', wanted the map's frame, not the odometry's, "
            f"'{found.wire.frame}' (wire.frame)"
        )
    if found.command.hash and not _HASH.fullmatch(found.command.hash):
        raise InputError(f"command.hash: got '{found.command.hash}', wanted RIHS01_ and 64 hex digits, or {NO_HASH}")


def _more_topics(found: RobotFile) -> list[tuple[str, str]]:
    """Key and name of the topics of sources, zones, frames, footprint and clock."""
    return [
        *(("sources.topic", one.topic) for one in found.sources),
        *(("sources.info", one.info) for one in found.sources),
        *(("sources.enable", one.enable) for one in found.sources),
        *(("zones.topic", one.topic) for one in found.zones),
        *(("zones.radius_topic", one.radius_topic) for one in found.zones),
        *(("zones.enable", one.enable) for one in found.zones),
        *(("exclusions.enable", one.enable) for one in found.exclusions),
        ("monitor.enable", found.monitor.enable),
        ("frames.fixed", found.frames.fixed),
        ("frames.moving", found.frames.moving),
        ("footprint.topic", found.footprint.topic),
        ("clock.topic", found.clock.topic),
        ("confirmation.topic", found.confirmation.topic),
    ]


def _check_scan(scan: ScanTopic) -> None:
    if len(scan.mount) != 3 or max(map(abs, scan.mount[:2])) > _WIDEST or abs(scan.mount[2]) > 2.0 * math.pi:
        raise InputError(f"scans.mount: got {list(scan.mount)}, wanted x ahead, y to the left in m, and a yaw in rad")
    if not 0.0 <= scan.delay <= 0.5:
        raise InputError(f"scans.delay: got {scan.delay}, wanted 0 to 0.5 s")
    if not re.fullmatch(r"[A-Za-z0-9_.-]{1,40}", scan.name):
        raise InputError(f"scans.name: got '{scan.name}', wanted letters, digits, '-', '_' or '.', at most 40")
