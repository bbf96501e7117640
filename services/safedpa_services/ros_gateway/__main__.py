"""``python -m safedpa_services.ros_gateway``: a robot that speaks ROS 2, as a robot of the bus.

A gateway as its file describes it: model, limits, the driver's type and hash, everything checked first.
"""

from __future__ import annotations

import argparse
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from safedpa.bus import Bus
from safedpa.bus.security.access_control import role_of_robot
from safedpa.bus.service.process import (
    RealtimePriority,
    StopSignal,
    add_bus_options,
    bus_from_options,
    log_lifetime,
    run_process,
)
from safedpa.dynamics import load_model
from safedpa.dynamics.own import load_own_of_environment
from safedpa.errors import InputError
from safedpa.robot import robot_named
from safedpa.ros.encoding import hash_of
from safedpa.ros.face import AbstractFace
from safedpa.ros.graph import PUBLISHER, SUBSCRIBER
from safedpa.ros.link import RosLink
from safedpa.safety.defaults import settings_named
from safedpa.systems.driven import why_not_driven
from safedpa_services.ros_gateway.echo_monitor import CommandEchoMonitor
from safedpa_services.ros_gateway.gateway import Gateway, Limits
from safedpa_services.ros_gateway.health_publisher import HealthPublisher
from safedpa_services.ros_gateway.localisation import TRANSFORMS, TransformListener
from safedpa_services.ros_gateway.robot_file import RobotFile, load_robot_file
from safedpa_services.ros_gateway.scanner import SCAN_TYPE, Scanner
from safedpa_services.ros_gateway.sensor_inputs import LatestMessage, SensorInputs, goal_paths, pose_paths

__all__ = ["checked_face", "make_gateway", "parser", "work"]

_POLICY = "policy"
"""Whose certificate is shown for the nominal action; it lies next to the robot's."""


def parser() -> argparse.ArgumentParser:
    """Options of the process."""
    found = argparse.ArgumentParser(prog="safedpa-ros-gateway")
    add_bus_options(found)
    found.add_argument("file", type=Path, metavar="ROBOT.toml", help="see docs/ros.md")
    found.add_argument(
        "--policy-card", type=int, metavar="DESCRIPTOR", help="read the policy's certificate and key there"
    )
    return found


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Drives until ``stop``; returns exit code 0."""
    load_own_of_environment()
    asked = load_robot_file(options.file)
    if options.certificates is not None and not options.role:
        options.role = role_of_robot(asked.name)
    with (
        bus_from_options(options) as bus,
        _policy_bus(options, bus, with_policy=bool(asked.nominal.topic)) as policy_bus,
        make_gateway(asked, bus, policy_bus) as gateway,
        log_lifetime("robot", stop),
    ):
        gateway.run(stop)
    return 0


@contextmanager
def _policy_bus(options: argparse.Namespace, bus: Bus, *, with_policy: bool) -> Iterator[Bus]:
    """The bus over which the robot's own policy requests: with certificates a robot's may not, the policy's may."""
    card, options.policy_card = options.policy_card, None
    if not with_policy or (options.certificates is None and card is None):
        yield bus
        return
    with bus_from_options(
        argparse.Namespace(**{**vars(options), "role": _POLICY, "card": card, "listen": []})
    ) as other:
        yield other


_GOAL = "geometry_msgs/msg/PoseStamped"
_DRIVER_SECONDS = 10.0
"""For the robot's driver to appear."""


def checked_face(asked: RobotFile) -> tuple[AbstractFace, Limits, float]:
    """How this robot speaks ROS, its limits, its period. Raises InputError for what does not fit together."""
    declared = robot_named(asked.robot)
    model = load_model(asked.model or str(declared.model))
    refusal = why_not_driven(model.system, asked.robot)
    if refusal:
        raise InputError(f"model '{asked.model}': {refusal}")
    declared = declared.of_system(model.system)
    face = declared.ros_face(model)
    if face is None:
        raise InputError(f"robot '{asked.robot}': it does not say how it speaks ROS; write its method 'ros_face'")
    for key, kind in (("command", asked.command.type), ("nominal", asked.nominal.type)):
        if kind and kind not in face.commands:
            raise InputError(f"{key}.type: got '{kind}', wanted one of {', '.join(face.commands)}")
    settings = settings_named(asked.settings or declared.settings_name)
    limits = (tuple(settings.action_low), tuple(settings.action_high), tuple(settings.resting_action))
    return face, limits, 1.0 / (asked.rate or declared.rate)


@contextmanager
def make_gateway(asked: RobotFile, bus: Bus, policy_bus: Bus | None = None) -> Iterator[Gateway]:
    """The gateway, joined to both sides; it requests over another bus where one is given.

    Raises InputError and BusError before anything is sent to the robot.
    """
    face, limits, period = checked_face(asked)
    wire = asked.wire
    with RosLink(wire.endpoint, wire.domain, "bridge" if wire.form == "bridge" else "rmw_zenoh") as link:
        command_type = asked.command.type or face.commands[0]
        type_hash = asked.command.hash or _hash_wanted(link, asked, command_type)
        bus.claim(asked.name, "robot", f"{time.time_ns():016x}-{secrets.token_hex(4)}")
        reported = [
            link.publisher(topic, kind) if topic else None
            for topic, kind in (
                (wire.diagnostics, "diagnostic_msgs/msg/DiagnosticArray"),
                (wire.markers, "visualization_msgs/msg/MarkerArray"),
            )
        ]
        health_publisher = HealthPublisher(asked.name, asked.frame, face, reported[0], reported[1])
        sensor_inputs = _sensor_inputs(link, asked, face, asked.nominal.type or command_type)
        command = link.publisher(asked.command.topic, command_type, type_hash)
        link.watched(asked.command.topic, PUBLISHER)  # from now on it is told
        yield Gateway(
            bus, link, asked, face, limits, sensor_inputs, command, health_publisher, period, policy_bus=policy_bus
        )


def _sensor_inputs(link: RosLink, asked: RobotFile, face: AbstractFace, nominal_type: str) -> SensorInputs:
    """Everything that the file names, heard from now on."""
    odometry = LatestMessage(asked.odometry.type, pose_paths(), asked.wire.frame)
    driver = CommandEchoMonitor(asked.command.topic)
    link.hear(asked.odometry.topic, asked.odometry.type, odometry.take)
    link.overhear(asked.command.topic, driver.take)
    nominal = goal = localised = None
    if asked.nominal.topic:
        nominal = LatestMessage(nominal_type, face.paths(nominal_type))
        link.hear(asked.nominal.topic, nominal_type, nominal.take)
    if asked.goal.topic:
        goal = LatestMessage(_GOAL, goal_paths(), asked.frame)
        link.hear(asked.goal.topic, _GOAL, goal.take)
    if asked.localisation.topic:
        localised = TransformListener(asked.localisation.frame, asked.wire.frame)
        link.hear(asked.localisation.topic, TRANSFORMS, localised.take)
    scanners = tuple(Scanner(scan.frame) for scan in asked.scans)
    for scan, scanner in zip(asked.scans, scanners, strict=True):
        link.hear(scan.topic, SCAN_TYPE, scanner.take)
    return SensorInputs(odometry, driver, nominal, goal, localised, scanners)


def _hash_wanted(link: RosLink, asked: RobotFile, command_type: str) -> str:
    """As the driver's own token asks. Raises InputError where it wants another type, or someone drives already."""
    if link.form != "rmw_zenoh":
        return hash_of(command_type)
    topic = asked.command.topic
    others = link.others_on(topic, PUBLISHER)
    if others:
        raise InputError(
            f"{topic}: {others[0].node} publishes there already; have it publish {asked.nominal.topic}, which goes "
            "through the filter, and let the gateway alone write the driver's topic"
        )
    end = time.monotonic() + _DRIVER_SECONDS
    while not (drivers := link.others_on(topic, SUBSCRIBER)):
        if time.monotonic() > end:
            raise InputError(
                f"{topic}: no one listens there after {_DRIVER_SECONDS:.0f} s; start the robot's driver, correct the "
                "topic, or name command.hash to drive all the same"
            )
        time.sleep(0.2)
    for driver in drivers:
        if driver.type != command_type:
            raise InputError(f"command.type: got '{command_type}', {driver.node} on {topic} wants '{driver.type}'")
    return drivers[0].hash


if __name__ == "__main__":
    run_process(work, parser(), RealtimePriority.ROBOT)
