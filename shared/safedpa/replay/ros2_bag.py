"""Exports a bus recording as a rosbag2 with standard messages, for Foxglove, Rerun and ROS 2."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from safedpa.bus.messages.messages import (
    ComputedMessage,
    HealthMessage,
    Message,
    NominalMessage,
    ScanMessage,
    SetupMessage,
    StateMessage,
    VerdictMessage,
)
from safedpa.bus.messages.topics import HEALTH, NOMINAL, SCAN, SETUP, STATE, VERDICT, topic_of
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.model_file import parse_model
from safedpa.errors import InputError, RecordingError, RunError, did_you_mean
from safedpa.records.readers.mcap import read_messages
from safedpa.records.run import Finding
from safedpa.ros.encoding import encode, stamp_of, type_store
from safedpa.ros.face import AbstractFace
from safedpa.ros.outgoing import diagnostics_of, laser_scan_of, odometry_of, path_marker, transform_of
from safedpa.systems.robots import Robot, robot_like, robots

_WORLD, _BODY = "odom", "base_link"
_TYPES = {
    "odom": "nav_msgs/msg/Odometry",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "scan": "sensor_msgs/msg/LaserScan",
    "state": "sensor_msgs/msg/JointState",
    "action": "sensor_msgs/msg/JointState",
    "nominal": "sensor_msgs/msg/JointState",
    "markers": "visualization_msgs/msg/MarkerArray",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
"""Message type by topic; a topic without a slash is below the name of the robot."""


@dataclass
class ExportedBag:
    """Summary of an export."""

    robot: str
    messages: int = 0
    findings: list[str] = field(default_factory=list)


def export_bag(recording: Path, out: Path, robot: str | None = None) -> ExportedBag:
    """Writes the drive of one robot as a rosbag2 folder ``out`` with an MCAP file; times are those of ``_Clock``.

    Topics: odometry, tf and command for a robot on the plane, of the type that its driver received; state, nominal
    action and action as named numbers; the scans of each source, and its mount on ``/tf_static``; diagnostics of every
    verdict; markers of obstacles and of the predicted path. Raises InputError if ``out`` exists,
    RunError if the recording cannot be used, and RecordingError if the bag cannot be written.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    if out.exists():
        raise InputError(f"{out}: exists already; name a new folder for the bag")
    findings: list[Finding] = []
    name, first = _robot_in(recording, robot)
    known = _robot_of_setup(recording, name) or (_robot_by_shape(recording, first), None)
    converter = _RosConverter(name, known[0], known[1], _driven_type(recording, name))
    exported = ExportedBag(name)
    try:
        with Writer(out, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections: dict[str, Any] = {}
            for topic, message, at, values in _converted(recording, name, converter, findings):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, message, typestore=type_store())
                writer.write(connections[topic], at, encode(message, values))
                exported.messages += 1
    except OSError as error:
        shutil.rmtree(out, ignore_errors=True)
        raise RecordingError(f"{out}: cannot be written ({error.strerror}); make room") from error
    exported.findings = [finding.message for finding in findings]
    return exported


def _robot_in(recording: Path, robot: str | None) -> tuple[str, StateMessage]:
    """Name and first state of the robot; raises RunError if there is none, or several without a choice."""
    found: dict[str, StateMessage] = {}
    for key, _, message in read_messages(recording, None, (STATE,)):
        if isinstance(message, StateMessage):
            found.setdefault(topic_of(key)[1], message)
    if not found:
        raise RunError(f"{recording}: contains no state of a robot; wanted a recording of the bus")
    if robot is None and len(found) > 1:
        raise RunError(f"{recording}: contains robots {', '.join(sorted(found))}; name one with --robot")
    name = robot or next(iter(found))
    if name not in found:
        raise RunError(f"{recording}: robot '{name}': {did_you_mean(name, found)}")
    return name, found[name]


def _robot_of_setup(recording: Path, name: str) -> tuple[Robot, PhysicsModel] | None:
    """Robot and model of the recorded setup of the services; it distinguishes a throttle from a speed command."""
    for key, _, message in read_messages(recording, None, (SETUP,)):
        if isinstance(message, SetupMessage) and message.document and topic_of(key)[1] in (name, "-"):
            try:
                model = parse_model(message.document, recording.parent)
            except InputError:
                continue  # networks whose weights are elsewhere
            found = robot_like(model.system)
            if found is not None:
                return found, model
    return None


def _driven_type(recording: Path, name: str) -> str:
    """Message type that the gateway sent to the driver; empty if none was recorded."""
    for key, _, message in read_messages(recording, None, (HEALTH,)):
        if isinstance(message, HealthMessage) and message.commands and topic_of(key)[1] == name:
            return message.commands
    return ""


def _robot_by_shape(recording: Path, state: StateMessage) -> Robot:
    for known in robots().values():
        shape = (len(known.system.state), len(known.system.action), not known.ros_face() or bool(state.field))
        if shape == (len(state.values), len(state.applied), True):
            return known
    raise RunError(
        f"{recording}: its robot has {len(state.values)} states, {len(state.applied)} actions: no known kind of robot; "
        "SAFEDPA_EFFECTS=FILE.py makes one of your own known"
    )


RosMessage = tuple[str, str, int, Mapping[str, Any]]


def _converted(recording: Path, name: str, converter: _RosConverter, findings: list[Finding]) -> Iterator[RosMessage]:
    """Yields (topic, type, ns, fields) of every converted message, in recorded order."""
    clock = _Clock()
    for key, _, message in read_messages(recording, findings, (STATE, VERDICT, NOMINAL, SCAN)):
        if topic_of(key)[1] == name:
            at = clock.of(message)
            for topic, kind, values in converter.of(message, at):
                yield (topic if topic.startswith("/") else f"/{_plain(name)}/{topic}"), kind, at, values


class _Clock:
    """Time of a message in the bag [ns]: its send time, or in lockstep the robot's own time.

    In lockstep messages are sent as soon as all services have answered, faster than real time.
    """

    def __init__(self) -> None:
        self._epoch_start: dict[int, float | None] = {}
        self._last = 0.0

    def of(self, message: Message) -> int:
        if not isinstance(message, ComputedMessage | StateMessage | ScanMessage):
            return round(message.publish_time * 1e9)
        if message.epoch not in self._epoch_start and isinstance(message, StateMessage):
            first = max(message.publish_time, self._last + message.period) - message.robot_time
            self._epoch_start[message.epoch] = first if message.lockstep else None
        begin = self._epoch_start.get(message.epoch)
        at = message.publish_time if begin is None else begin + message.robot_time
        self._last = max(self._last, at)
        return round(at * 1e9)


def _plain(name: str) -> str:
    """Converts to a valid ROS name: letters, digits and underscores, beginning with a letter."""
    plain = "".join(sign if sign.isascii() and (sign.isalnum() or sign == "_") else "_" for sign in name)
    return plain if plain[:1].isalpha() else f"robot_{plain}"


class _RosConverter:
    """Converts bus messages of one robot to ROS messages."""

    def __init__(self, name: str, robot: Robot, model: PhysicsModel | None = None, command: str = "") -> None:
        self._name, self._system = name, robot.system
        self._mounts: dict[str, tuple[float, ...]] = {}
        self._face: AbstractFace | None = robot.ros_face(model)
        known = () if self._face is None else self._face.commands
        self._command = command if command in known else (known[0] if known else "")
        self._frame = f"{_plain(name)}/{_BODY}"
        self._values: tuple[float, ...] = ()
        self._stamp = (0, -1)

    def of(self, message: Message, at: int) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
        head = {"stamp": stamp_of(at), "frame_id": _WORLD}
        if isinstance(message, StateMessage):
            if (message.epoch, message.tick) == self._stamp:
                return  # in lockstep a robot repeats its state until it is answered
            self._stamp, self._values = (message.epoch, message.tick), message.values
            yield "state", _TYPES["state"], self._numbers(head, self._system.state_names, message.values)
            yield "action", _TYPES["action"], self._numbers(head, self._system.action_names, message.applied)
            if self._face is not None:
                pose = self._face.planar(message.values)
                aside = self._face.aside(message.values)
                yield "odom", _TYPES["odom"], odometry_of(head, self._frame, *pose, aside)
                yield "/tf", _TYPES["/tf"], {"transforms": [transform_of(head, self._frame, *pose[:3])]}
                command = self._command
                header = {"header": head} if command.endswith("Stamped") else {}
                yield "command", command, {**header, **self._face.message(command, message.applied, message.values)}
                if message.obstacles:
                    yield "markers", _TYPES["markers"], {"markers": _obstacle_markers(head, message.obstacles)}
        elif isinstance(message, ScanMessage):
            yield from self._scan(message, at)
        elif isinstance(message, NominalMessage):
            yield "nominal", _TYPES["nominal"], self._numbers(head, self._system.action_names, message.values)
        elif isinstance(message, VerdictMessage):
            yield "/diagnostics", _TYPES["/diagnostics"], diagnostics_of(head, self._name, message)
            if self._face is not None and len(message.predicted) > 1:
                places = [self._face.planar(row)[:2] for row in message.predicted]
                yield "markers", _TYPES["markers"], {"markers": [path_marker(head, places)]}

    def _scan(self, message: ScanMessage, at: int) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
        """The scan in a frame of its source, whose mount is published before if it is new."""
        frame = f"{_plain(self._name)}/{_plain(message.source)}"
        if self._mounts.get(message.source) != message.mount:
            self._mounts[message.source] = message.mount
            head = {"stamp": stamp_of(at), "frame_id": self._frame}
            yield "/tf_static", _TYPES["/tf_static"], {"transforms": [transform_of(head, frame, *message.mount[:3])]}
        topic = "scan" if message.source == "laser" else f"scan/{_plain(message.source)}"
        yield topic, _TYPES["scan"], laser_scan_of({"stamp": stamp_of(at), "frame_id": frame}, message)

    @staticmethod
    def _numbers(head: Mapping[str, Any], names: tuple[str, ...], values: tuple[float, ...]) -> dict[str, Any]:
        return {"header": head, "name": list(names), "position": list(values)}


def _obstacle_markers(head: Mapping[str, Any], obstacles: tuple[tuple[float, ...], ...]) -> list[dict[str, Any]]:
    return [
        {
            "header": head,
            "ns": "obstacles",
            "id": number,
            "type": 3,  # a cylinder
            "pose": {"position": {"x": x, "y": y}, "orientation": {"w": 1.0}},
            "scale": {"x": 2.0 * radius, "y": 2.0 * radius, "z": 0.1},
            "color": {"r": 0.8, "g": 0.3, "b": 0.2, "a": 0.9},
        }
        for number, (x, y, radius) in enumerate(obstacles)
        if math.isfinite(radius)
    ]
