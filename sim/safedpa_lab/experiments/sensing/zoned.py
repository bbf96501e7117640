"""The speed zones of a converted Nav2 file between the policy and the filter, as the ROS gateway has them.

All sources of the file are the one simulated sensor: its points count for each of them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import final

from safedpa.bus import NOMINAL, SCAN, AbstractNode, Inputs, Message, NominalMessage, Outputs, ScanMessage, StateMessage
from safedpa.bus.messages.topics import Topic
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.ros.face import AbstractFace
from safedpa.systems.robots import Robot
from safedpa_lab.experiments.sensing.nodes import ScanPoints
from safedpa_services.ros_gateway.collision_monitor import Conversion, convert_collision_monitor
from safedpa_services.ros_gateway.robot_file import RobotFile, parse_robot_file
from safedpa_services.ros_gateway.speed_zones import SpeedZones, scaled, velocity_of

_TWIST = "geometry_msgs/msg/Twist"


def converted(path: Path, robot: str) -> tuple[RobotFile, Conversion]:
    """Converts the parameters of a collision monitor; raises InputError as the converter and the robot file do."""
    conversion = convert_collision_monitor(path, robot)
    try:
        file = parse_robot_file(conversion.text)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    for zone in file.zones:
        if zone.topic:
            raise InputError(f"{path}: {zone.name}: got a shape from the topic {zone.topic}, wanted points in the file")
    return file, conversion


def face_of(robot: Robot) -> AbstractFace:
    """Returns the ROS interface of a robot that Twist drives; raises InputError for others."""
    face: AbstractFace | None = robot.ros_face()
    if face is None or _TWIST not in face.commands:
        raise InputError(
            f"--monitor: got the robot '{robot.name}', wanted one that Twist drives, as differential_drive"
        )
    return face


@final
class ZonedPolicy(AbstractNode):
    """A policy whose nominal actions the zones of a robot file scale down."""

    name = PolicyNode.name
    inputs = PolicyNode.inputs
    outputs = PolicyNode.outputs
    sensor_inputs = PolicyNode.sensor_inputs
    slack = PolicyNode.slack
    share = PolicyNode.share
    listens = (*PolicyNode.listens, SCAN)

    def __init__(self, policy: PolicyNode, face: AbstractFace, file: RobotFile) -> None:
        self._policy, self._face = policy, face
        self._zones, self._sources = SpeedZones(file.zones), [one.name for one in file.sensors if one.enabled]
        self._scans = ScanPoints()
        self.acted = 0
        """Ticks in which a zone acted."""

    def needs(self, state: StateMessage) -> tuple[Topic, ...]:  # noqa: D102
        return self._policy.needs(state)

    def hear(self, robot: str, message: Message) -> None:  # noqa: D102
        if isinstance(message, ScanMessage):
            self._scans.hear(message)
        else:
            self._policy.hear(robot, message)

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        found = dict(self._policy.step(robot, state, inputs))
        points, nominal = self._scans.points(state), found.get(NOMINAL)
        if not isinstance(nominal, NominalMessage):
            return found
        twist = self._face.message(_TWIST, nominal.values, state.values)
        share = 0.0  # a source that is silent stops the robot
        if points is not None:
            share = self._zones.limit(velocity_of(twist), dict.fromkeys(self._sources, points)).share
        self.acted += share < 1.0
        paths = self._face.paths(_TWIST)
        numbers = scaled([_field(twist, path) for path in paths], paths, share)
        values = self._face.action(_TWIST, numbers, state.values)
        return {**found, NOMINAL: replace(nominal, values=values)}


def _field(twist: object, path: str) -> float:
    value: object = twist
    for part in path.split("."):
        value = value.get(part, 0.0) if isinstance(value, dict) else 0.0
    return float(value) if isinstance(value, (int, float)) else 0.0
