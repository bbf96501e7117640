"""``robot.toml``: which robot, where it is reached, what it tells, who wishes, and how it is driven."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, get_args, get_type_hints

from safedpa.errors import InputError, did_you_mean
from safedpa.limits import finite_number, parse_toml, text_of_file, whole_number
from safedpa_services.ros_gateway.robot_file_checks import check_robot_file, check_served

__all__ = [
    "Command",
    "Goal",
    "Localisation",
    "Odometry",
    "RobotFile",
    "Scan",
    "Served",
    "Surroundings",
    "Wire",
    "Wish",
    "load_robot_file",
    "load_served",
]

FORMAT = 1


@dataclass(frozen=True)
class Wire:
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
class Odometry:
    """Where the robot says that it is."""

    topic: str
    type: str = "nav_msgs/msg/Odometry"
    ahead: float = 0.0
    """m from the robot's reference point to the one that is told; of a car from its rear axle."""
    largest_age: float = 0.1
    """s; without a newer one for so long the robot brakes."""


@dataclass(frozen=True)
class Wish:
    """What the robot's own policy would do; it goes through the filter."""

    topic: str = ""
    """Empty: a policy of this side wishes (``safedpa serve --policy``)."""
    type: str = ""
    """Empty: that of the command."""
    largest_age: float = 0.5


@dataclass(frozen=True)
class Command:
    """What its driver obeys. Nobody else may speak there."""

    topic: str
    type: str = ""
    """Empty: the usual one of this robot."""
    hash: str = ""
    """Of the type; empty: as the driver's own token asks, else computed."""


@dataclass(frozen=True)
class Goal:
    """Where people say that it shall go, ``geometry_msgs/PoseStamped``; for a policy of this side."""

    topic: str = ""


@dataclass(frozen=True)
class Localisation:
    """What corrects the odometry: transforms from the map to the odometry's frame."""

    topic: str = ""
    frame: str = "map"
    """That of the surroundings and the goal, then."""
    largest_age: float = 1.0
    """s; without a newer one for so long the robot brakes."""


@dataclass(frozen=True)
class Scan:
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
class Surroundings:
    """What is around it and does not move, in the frame of the odometry."""

    field: tuple[float, ...]
    """Lowest x, highest x, lowest y, highest y [m]."""
    footprint: tuple[float, ...]
    """How far it reaches behind and ahead of its reference point, and its radius [m]."""
    obstacles: tuple[tuple[float, ...], ...] = ()
    """x, y, radius [m] each."""
    goal: tuple[float, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Served:
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
class RobotFile(Served):
    """One that speaks ROS 2: all of it."""

    odometry: Odometry
    command: Command
    surroundings: Surroundings
    wish: Wish = field(default_factory=Wish)
    goal: Goal = field(default_factory=Goal)
    localisation: Localisation = field(default_factory=Localisation)
    scans: tuple[Scan, ...] = ()
    wire: Wire = field(default_factory=Wire)

    @property
    def frame(self) -> str:
        """In which its pose, its goal and what is around it are told."""
        return self.localisation.frame if self.localisation.topic else self.wire.frame


def load_robot_file(path: Path) -> RobotFile:
    """The file of a robot that speaks ROS 2. Raises InputError naming it and the key."""
    found = _loaded(path, lambda table: RobotFile)
    assert isinstance(found, RobotFile)
    return found


def load_served(path: Path) -> Served:
    """The file of any robot: a RobotFile where it says anything of ROS. Raises InputError naming it and the key."""
    own = {item.name for item in fields(RobotFile)} - {item.name for item in fields(Served)}
    return _loaded(path, lambda table: RobotFile if own & table.keys() else Served)


def _loaded(path: Path, kind_of: Callable[[Mapping[str, Any]], type[Served]]) -> Served:
    try:
        table = parse_toml(text_of_file(path, "toml_bytes"))
        if table.pop("format", None) != FORMAT:
            raise InputError(f"format: wanted {FORMAT}; this program reads no other")
        found: Served = _of(kind_of(table), table, "")
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
