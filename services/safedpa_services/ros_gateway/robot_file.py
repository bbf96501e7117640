"""``robot.toml``: which robot, where it is reached, what it tells, who requests, and how it is driven.

What cannot be in it is told by key, before anything is joined or moved.
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
from safedpa.robot import robot_named
from safedpa.ros.graph import NO_HASH
from safedpa.ros.link import FORMS
from safedpa.runtime.scene import MOST_OBSTACLES

__all__ = [
    "CommandTopic",
    "GoalTopic",
    "LocalisationTopic",
    "NominalActionTopic",
    "ObstaclesTopic",
    "OdometryTopic",
    "RobotFile",
    "RosConnection",
    "ScanTopic",
    "ServedRobot",
    "check_robot_file",
    "check_served",
    "load_robot_file",
    "load_served_robot",
]

FORMAT = 2


@dataclass(frozen=True)
class RosConnection:
    """Where the robot's Zenoh router listens, and how its nodes write."""

    endpoint: str = "tcp/127.0.0.1:7447"
    domain: int = 0
    form: str = "rmw_zenoh"
    """``rmw_zenoh``, or ``bridge`` for zenoh-bridge-ros2dds."""
    diagnostics: str = "/diagnostics"
    """Where verdicts are told; empty: nowhere."""
    markers: str = "/safedpa/markers"
    """Where the path is drawn that the filter foresees; empty: nowhere."""
    frame: str = "odom"


@dataclass(frozen=True)
class OdometryTopic:
    """Where the robot says that it is."""

    topic: str
    type: str = "nav_msgs/msg/Odometry"
    ahead: float = 0.0
    """m from the robot's reference point to the one that is told; of a car from its rear axle."""
    largest_age: float = 0.1
    """s; without a newer one for so long the robot brakes."""


@dataclass(frozen=True)
class NominalActionTopic:
    """What the robot's own policy would do; it goes through the filter."""

    topic: str = ""
    """Empty: a policy of this side requests (``safedpa serve --policy``)."""
    type: str = ""
    """Empty: that of the command."""
    largest_age: float = 0.5


@dataclass(frozen=True)
class CommandTopic:
    """What its driver obeys. No one else may speak there."""

    topic: str
    type: str = ""
    """Empty: the usual one of this robot."""
    hash: str = ""
    """Of the type; empty: as the driver's own token asks, else computed."""


@dataclass(frozen=True)
class GoalTopic:
    """Where people say that it shall go, ``geometry_msgs/PoseStamped``; for a policy of this side."""

    topic: str = ""


@dataclass(frozen=True)
class LocalisationTopic:
    """What corrects the odometry: transforms from the map to the odometry's frame."""

    topic: str = ""
    frame: str = "map"
    """That of the surroundings and the goal, then."""
    largest_age: float = 1.0
    """s; without a newer one for so long the robot brakes."""


@dataclass(frozen=True)
class ScanTopic:
    """A laser scanner, ``sensor_msgs/LaserScan``; with one nothing is told of obstacles: perception sees them."""

    topic: str
    name: str = "laser"
    frame: str = ""
    """Of its messages; others are refused. Empty: any."""
    mount: tuple[float, ...] = (0.0, 0.0, 0.0)
    """x ahead of the robot's reference point, y to its left [m], and the yaw of its angle 0 [rad]."""
    delay: float = 0.0
    """s from the middle of its turn to the arrival of its message."""


@dataclass(frozen=True)
class ObstaclesTopic:
    """What is around it and does not move, in the frame of the odometry."""

    field: tuple[float, ...]
    """Lowest x, highest x, lowest y, highest y [m]."""
    footprint: tuple[float, ...]
    """How far it reaches behind and ahead of its reference point, and its radius [m]."""
    obstacles: tuple[tuple[float, ...], ...] = ()
    """x, y, radius [m] each."""
    goal: tuple[float, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ServedRobot:
    """Which robot the services are for."""

    robot: str
    name: str = "r1"
    model: str = ""
    """Model file, or the name of one that ships; empty: that of the robot."""
    settings: str = ""
    margin: str = ""
    rate: float = 0.0
    """Ticks per second; 0: the robot's own."""


@dataclass(frozen=True, kw_only=True)
class RobotFile(ServedRobot):
    """One that speaks ROS 2: all of it."""

    odometry: OdometryTopic
    command: CommandTopic
    surroundings: ObstaclesTopic
    nominal: NominalActionTopic = field(default_factory=NominalActionTopic)
    goal: GoalTopic = field(default_factory=GoalTopic)
    localisation: LocalisationTopic = field(default_factory=LocalisationTopic)
    scans: tuple[ScanTopic, ...] = ()
    wire: RosConnection = field(default_factory=RosConnection)

    @property
    def frame(self) -> str:
        """In which its pose, its goal and what is around it are told."""
        return self.localisation.frame if self.localisation.topic else self.wire.frame


def load_robot_file(path: Path) -> RobotFile:
    """The file of a robot that speaks ROS 2. Raises InputError naming it and the key."""
    found = _loaded(path, lambda table: RobotFile)
    assert isinstance(found, RobotFile)
    return found


def load_served_robot(path: Path) -> ServedRobot:
    """The file of any robot: a RobotFile where it says anything of ROS. Raises InputError naming it and the key."""
    own = {item.name for item in fields(RobotFile)} - {item.name for item in fields(ServedRobot)}
    return _loaded(path, lambda table: RobotFile if own & table.keys() else ServedRobot)


def _loaded(path: Path, kind_of: Callable[[Mapping[str, Any]], type[ServedRobot]]) -> ServedRobot:
    try:
        table = parse_toml(text_of_file(path, "toml_bytes"))
        if table.pop("format", None) != FORMAT:
            raise InputError(f"format: wanted {FORMAT}; convert an earlier file with 'safedpa migrate'")
        found: ServedRobot = _of(kind_of(table), table, "")
        check_served(found)
        if isinstance(found, RobotFile):
            check_robot_file(found)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', error)}); wanted one") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return found


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
            raise InputError(f"{prefix}{name}: missing; docs/ros.md has a whole file")
    return kind(**given)


def _value(kind: Any, value: Any, key: str) -> Any:
    if hasattr(kind, "__dataclass_fields__"):
        if not isinstance(value, dict):
            raise InputError(f"{key}: got {value!r}, wanted a table [{key}]")
        return _of(kind, value, f"{key}.")
    if kind is str:
        if not isinstance(value, str):
            raise InputError(f"{key}: got {value!r}, wanted a text in quotes")
        return value
    if kind in (float, int):
        return finite_number(key, value) if kind is float else whole_number(key, value)
    inner = get_args(kind)[0]
    if not isinstance(value, list):
        wanted = f"tables [[{key}]]" if hasattr(inner, "__dataclass_fields__") else "a list of numbers"
        raise InputError(f"{key}: got {value!r}, wanted {wanted}")
    return tuple(_value(inner, one, key) for one in value)


_TOPIC = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
"""A name of ROS without substitutions (design.ros2.org/articles/topic_and_service_names.html)."""
_HASH = re.compile(rf"RIHS01_[0-9a-f]{{64}}|{NO_HASH}")
_LARGEST = 1e4
"""m; no robot of a field of 10 km sees its walls."""
_WIDEST = 100.0
_ODOMETRY = "nav_msgs/msg/Odometry"


def check_served(found: ServedRobot) -> None:
    """Raises InputError for a name that the bus cannot carry, a robot that no one knows, a rate that is none."""
    robot_named(found.robot)
    try:
        key_of("fleet", found.name, STATE)
    except InputError as error:
        raise InputError(f"name: {str(error).removeprefix('name ')}") from error
    if found.rate and not 1.0 <= found.rate <= 500.0:
        raise InputError(f"rate: got {found.rate}, wanted 1 to 500 ticks per second, or none for the robot's own")


def check_robot_file(found: RobotFile) -> None:
    """Raises InputError naming the key."""
    _check_surroundings(found.surroundings)
    _check_wire(found)
    _check_ages(found)
    _check_topics(found)
    for scan in found.scans:
        _check_scan(scan)
    names = [scan.name for scan in found.scans]
    if len({*names}) < len(names):
        raise InputError(f"scans.name: got {', '.join(names)}, wanted another one for each scanner")
    if found.scans and found.surroundings.obstacles:
        raise InputError(
            "surroundings.obstacles: got some next to [[scans]], wanted none: perception tells what is seen"
        )


def _check_surroundings(around: ObstaclesTopic) -> None:
    for key, values, count in (("field", around.field, 4), ("footprint", around.footprint, 3)):
        if len(values) != count:
            raise InputError(f"surroundings.{key}: got {len(values)} numbers, wanted {count}")
        if max(map(abs, values)) > _LARGEST:
            raise InputError(f"surroundings.{key}: got {list(values)}, wanted m, {_LARGEST:g} at most")
    west, east, south, north = around.field
    rear, front, radius = around.footprint
    if not 0.0 < radius <= _WIDEST or not -front <= rear <= _WIDEST or front > _WIDEST:
        raise InputError(
            f"surroundings.footprint: got {list(around.footprint)}, wanted how far it reaches behind and ahead of its "
            f"reference point, together 0 or more, and a radius above 0; m, {_WIDEST:g} at most"
        )
    if east - west <= 2.0 * radius or north - south <= 2.0 * radius:
        raise InputError(
            f"surroundings.field: got {list(around.field)}, wanted lowest x, highest x, lowest y, highest y in m, with "
            f"room for a robot that is {2.0 * radius:g} m wide"
        )
    if len(around.obstacles) > MOST_OBSTACLES:
        raise InputError(f"surroundings.obstacles: got {len(around.obstacles)}, wanted at most {MOST_OBSTACLES}")
    if any(len(one) != 3 or not 0.0 < one[2] <= _LARGEST for one in around.obstacles):
        raise InputError("surroundings.obstacles: wanted x, y and a radius above 0 of each")
    if around.goal and not (len(around.goal) == 2 and west < around.goal[0] < east and south < around.goal[1] < north):
        raise InputError(f"surroundings.goal: got {list(around.goal)}, wanted x and y within the field, or none")


def _check_wire(found: RobotFile) -> None:
    wire = found.wire
    if wire.form not in FORMS:
        raise InputError(f"wire.form: got '{wire.form}', wanted {' or '.join(FORMS)}")
    if not 0 <= wire.domain <= 232:
        raise InputError(f"wire.domain: got {wire.domain}, wanted 0 to 232")
    if not re.fullmatch(r"[a-z-]+/[^\s#?]+", wire.endpoint):
        raise InputError(f"wire.endpoint: got '{wire.endpoint}', wanted one such as tcp/robot:7447")


def _check_ages(found: RobotFile) -> None:
    ages = [("odometry", found.odometry.largest_age), ("nominal", found.nominal.largest_age)]
    for key, age in [*ages, ("localisation", found.localisation.largest_age)]:
        if not 0.0 < age <= 2.0:
            raise InputError(f"{key}.largest_age: got {age}, wanted more than 0 and at most 2 s")
    if not abs(found.odometry.ahead) <= _WIDEST:
        raise InputError(f"odometry.ahead: got {found.odometry.ahead}, wanted m, {_WIDEST:g} at most")
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
    notice = {"wire.diagnostics": found.wire.diagnostics, "wire.markers": found.wire.markers}
    heard = [*topics.items(), *(("scans", scan.topic) for scan in found.scans)]
    for key, topic in [*((f"{key}.topic", topic) for key, topic in heard), *notice.items()]:
        if not _TOPIC.fullmatch(topic) and (topic or key in ("odometry.topic", "command.topic", "scans.topic")):
            raise InputError(f"{key}: got '{topic}', wanted a topic such as /odom: letters, digits, '_' and '/'")
    for key, topic in notice.items():  # over a bridge its bytes would be taken for a command
        if topic.strip("/") == found.command.topic.strip("/"):
            raise InputError(f"{key}: got the command's own topic, '{topic}': the driver obeys what comes there")
    if found.nominal.topic.strip("/") == found.command.topic.strip("/"):
        raise InputError(
            f"nominal.topic: got the command's own, '{found.command.topic}': the policy would speak past the filter; have "
            "it publish another one, drive_in say"
        )
    if found.localisation.topic and found.localisation.frame.strip("/") in ("", found.wire.frame.strip("/")):
        raise InputError(
            f"localisation.frame: got '{found.localisation.frame}', wanted the map's, another than the odometry's, "
            f"'{found.wire.frame}' (wire.frame)"
        )
    if found.command.hash and not _HASH.fullmatch(found.command.hash):
        raise InputError(f"command.hash: got '{found.command.hash}', wanted RIHS01_ and 64 hex digits, or {NO_HASH}")


def _check_scan(scan: ScanTopic) -> None:
    if len(scan.mount) != 3 or max(map(abs, scan.mount[:2])) > _WIDEST or abs(scan.mount[2]) > 2.0 * math.pi:
        raise InputError(f"scans.mount: got {list(scan.mount)}, wanted x ahead, y to the left in m, and a yaw in rad")
    if not 0.0 <= scan.delay <= 0.5:
        raise InputError(f"scans.delay: got {scan.delay}, wanted 0 to 0.5 s")
    if not re.fullmatch(r"[A-Za-z0-9_.-]{1,40}", scan.name):
        raise InputError(f"scans.name: got '{scan.name}', wanted letters, digits, '-', '_' or '.', at most 40")
