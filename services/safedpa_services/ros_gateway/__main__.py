"""``python -m safedpa_services.ros_gateway``: connects a robot that uses ROS 2 to the bus.

Builds the gateway from the robot's file. Model, limits, and the type and hash of the driver's topic are checked first.
"""

from __future__ import annotations

import argparse
import secrets
import time
from collections.abc import Callable, Iterator
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
from safedpa.dynamics.user_files import load_user_files
from safedpa.errors import InputError
from safedpa.ros.encoding import hash_of
from safedpa.ros.face import AbstractFace
from safedpa.ros.graph import PUBLISHER, SUBSCRIBER
from safedpa.ros.link import RosLink
from safedpa.ros.sensor_messages import CAMERA_INFO, POLYGON
from safedpa.runtime.scene import check_senses
from safedpa.safety.defaults import settings_named
from safedpa.systems.registry import why_not_driven
from safedpa.systems.robots import robot_named
from safedpa_services.ros_gateway.gateway import TWIST, Gateway, HealthPublisher, Limits
from safedpa_services.ros_gateway.gateway_inputs import SensorInputs
from safedpa_services.ros_gateway.pose_confirmation import CONFIRMED_POSE, PoseConfirmation
from safedpa_services.ros_gateway.publisher_monitor import CommandEchoMonitor
from safedpa_services.ros_gateway.robot_file import RobotFile, load_robot_file, uses_transforms
from safedpa_services.ros_gateway.sensor_inputs import (
    TRANSFORMS,
    FootprintInput,
    LatestMessage,
    NominalInput,
    TransformListener,
    goal_paths,
    pose_paths,
)
from safedpa_services.ros_gateway.simulated_clock import CLOCK, SimulatedClock
from safedpa_services.ros_gateway.sources import BodyFrames, SourceReader, SourceReceiver, body_frames
from safedpa_services.ros_gateway.speed_zones import BOOL, FLOAT, SpeedZones, ToggleInput, ZonePolygon, ZoneRadius

_POLICY = "policy"
"""Role whose certificate is used to publish nominal actions; its files are in the same folder as the robot's."""


def parser() -> argparse.ArgumentParser:
    """Returns a parser with the options of the process."""
    found = argparse.ArgumentParser(prog="safedpa-ros-gateway")
    add_bus_options(found)
    found.add_argument("file", type=Path, metavar="ROBOT.toml", help="see docs/guides/ros.md")
    found.add_argument(
        "--policy-card",
        type=int,
        metavar="DESCRIPTOR",
        help="descriptor of a pipe with the policy's certificate and key",
    )
    return found


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Drives until ``stop``; returns exit code 0."""
    load_user_files()
    robot_file = load_robot_file(options.file)
    if options.certificates is not None and not options.role:
        options.role = role_of_robot(robot_file.name)
    with (
        bus_from_options(options) as bus,
        _policy_bus(options, bus, with_policy=bool(robot_file.nominal.topic)) as policy_bus,
        make_gateway(robot_file, bus, policy_bus) as gateway,
        log_lifetime("robot", stop),
    ):
        gateway.run(stop)
    return 0


@contextmanager
def _policy_bus(options: argparse.Namespace, bus: Bus, *, with_policy: bool) -> Iterator[Bus]:
    """Yields the bus for nominal actions. With certificates, only the role ``policy`` may publish them."""
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
"""Time to wait for the robot's driver to appear."""


def load_ros_interface(robot_file: RobotFile) -> tuple[AbstractFace, Limits, float]:
    """Returns the robot's ROS interface, its action limits and its period [s].

    Raises InputError if model, settings and message types do not fit together.
    """
    declared = robot_named(robot_file.robot)
    model = load_model(robot_file.model or str(declared.model))
    refusal = why_not_driven(model.system, robot_file.robot)
    if refusal:
        raise InputError(f"model '{robot_file.model}': {refusal}")
    declared = declared.of_system(model.system)
    face = declared.ros_face(model)
    if face is None:
        raise InputError(f"robot '{robot_file.robot}': got no ROS interface; implement its method 'ros_face'")
    for key, kind in (("command", robot_file.command.type), ("nominal", robot_file.nominal.type)):
        if kind and kind not in face.commands:
            raise InputError(f"{key}.type: got '{kind}', wanted one of {', '.join(face.commands)}")
    if robot_file.zones and TWIST not in face.commands:
        raise InputError(f"zones: got some, but the commands of a {robot_file.robot} have no velocity ({TWIST})")
    settings = settings_named(robot_file.settings or declared.settings_name)
    if robot_file.sensors:
        check_senses(model, settings, "[[scans]] or [[sources]]")
    limits = (tuple(settings.action_low), tuple(settings.action_high), tuple(settings.resting_action))
    return face, limits, 1.0 / (robot_file.rate or declared.rate)


@contextmanager
def make_gateway(robot_file: RobotFile, bus: Bus, policy_bus: Bus | None = None) -> Iterator[Gateway]:
    """Yields the gateway, connected to the bus and to ROS; nominal actions go over ``policy_bus`` if one is given.

    Raises InputError or BusError before anything is sent to the robot.
    """
    face, limits, period = load_ros_interface(robot_file)
    wire = robot_file.wire
    with RosLink(wire.endpoint, wire.domain, "bridge" if wire.form == "bridge" else "rmw_zenoh") as link:
        command_type = robot_file.command.type or face.commands[0]
        type_hash = robot_file.command.hash or _driver_type_hash(link, robot_file, command_type)
        bus.claim(robot_file.name, "robot", f"{time.time_ns():016x}-{secrets.token_hex(4)}")
        publishers = [
            link.publisher(topic, kind) if topic else None
            for topic, kind in (
                (wire.diagnostics, "diagnostic_msgs/msg/DiagnosticArray"),
                (wire.markers, "visualization_msgs/msg/MarkerArray"),
                (robot_file.monitor.state, "nav2_msgs/msg/CollisionMonitorState"),
            )
        ]
        health_publisher = HealthPublisher(robot_file.name, robot_file.frame, face, publishers[0], publishers[1])
        simulated = None
        if robot_file.clock.topic:
            simulated = SimulatedClock(robot_file.clock.largest_gap)
            link.hear(robot_file.clock.topic, CLOCK, simulated.take)
        nominal_type = robot_file.nominal.type or command_type
        sensor_inputs = _sensor_inputs(link, robot_file, face, nominal_type, simulated)
        command = link.publisher(robot_file.command.topic, command_type, type_hash)
        link.watched(robot_file.command.topic, PUBLISHER)  # subscribes to graph events now; later calls do not block
        yield Gateway(
            bus, link, robot_file, face, limits, sensor_inputs, command, health_publisher, period,
            clock=simulated or time.monotonic, policy_bus=policy_bus, zone_state=publishers[2],
            confirmation=_confirmation(link, robot_file, bus, simulated or time.monotonic),
        )  # fmt: skip


def _sensor_inputs(
    link: RosLink, robot_file: RobotFile, face: AbstractFace, nominal_type: str, simulated: SimulatedClock | None
) -> SensorInputs:
    """Subscribes to all topics that the file names."""
    clock = simulated or time.monotonic
    odometry = LatestMessage(robot_file.odometry.type, pose_paths(), robot_file.wire.frame, clock)
    driver = CommandEchoMonitor(robot_file.command.topic)
    link.hear(robot_file.odometry.topic, robot_file.odometry.type, odometry.take)
    link.overhear(robot_file.command.topic, driver.take)
    nominal = goal = localised = None
    if robot_file.nominal.topic:
        # Over a bridge the type is not part of the key, so that only the expected type can be decoded.
        kinds = face.commands if link.form == "rmw_zenoh" else ()
        types = dict.fromkeys((nominal_type, *kinds))
        nominal = NominalInput({kind: face.paths(kind) for kind in types}, clock)
        for kind, one in nominal.inputs.items():
            link.hear(robot_file.nominal.topic, kind, one.take)
    if robot_file.goal.topic:
        goal = LatestMessage(_GOAL, goal_paths(), robot_file.frame, clock)
        link.hear(robot_file.goal.topic, _GOAL, goal.take)
    if robot_file.localisation.topic:
        localised = TransformListener(robot_file.localisation.frame, robot_file.wire.frame, clock)
        link.hear(robot_file.localisation.topic, TRANSFORMS, localised.take)
    frames = body_frames(robot_file, odometry, localised, clock)
    if uses_transforms(robot_file):
        link.hear(robot_file.frames.fixed, TRANSFORMS, frames.take_fixed, late=True)
        link.hear(robot_file.frames.moving, TRANSFORMS, frames.take_moving)
    return SensorInputs(
        odometry, driver, nominal, goal, localised, simulated=simulated,
        sources=_sources(link, robot_file, frames, clock), footprint=_footprint(link, robot_file, frames, clock),
        zones=_zones(link, robot_file, frames), counted=_counted(link, robot_file),
    )  # fmt: skip


def _confirmation(
    link: RosLink, robot_file: RobotFile, bus: Bus, clock: Callable[[], float]
) -> PoseConfirmation | None:
    topic = robot_file.confirmation
    if not topic.topic:
        return None
    found = PoseConfirmation(bus, robot_file.name, topic, robot_file.frame, clock)
    link.hear(topic.topic, CONFIRMED_POSE, found.input.take)
    return found


def _sources(
    link: RosLink, robot_file: RobotFile, frames: BodyFrames, clock: Callable[[], float]
) -> tuple[SourceReceiver, ...]:
    found = []
    excludes = {one.name: _switch(link, one.enable, on=one.enabled) for one in robot_file.exclusions}
    for topic in robot_file.sensors:
        reader = SourceReader(topic, robot_file.exclusions, frames, robot_file.wire.frame, excludes)
        found.append(SourceReceiver(reader, clock))
        link.hear(topic.topic, topic.type, found[-1].take)
        if topic.info:
            link.hear(topic.info, CAMERA_INFO, found[-1].take_info)
    return tuple(found)


def _footprint(
    link: RosLink, robot_file: RobotFile, frames: BodyFrames, clock: Callable[[], float]
) -> FootprintInput | None:
    topic = robot_file.footprint
    if not topic.topic:
        return None
    found = FootprintInput(lambda frame: frames.of(frame, clock()), topic.hold, clock)
    link.hear(topic.topic, POLYGON, found.take)
    return found


def _zones(link: RosLink, robot_file: RobotFile, frames: BodyFrames) -> SpeedZones | None:
    if not robot_file.zones:
        return None
    shapes: dict[str, ZonePolygon | ZoneRadius] = {}
    switches = {}
    for zone in robot_file.zones:
        switches[zone.name] = _switch(link, zone.enable, on=zone.enabled)
        if zone.topic:
            shapes[zone.name] = ZonePolygon(lambda frame: frames.of(frame, time.monotonic()))
            link.hear(zone.topic, POLYGON, shapes[zone.name].take)
        if zone.radius_topic:
            shapes[zone.name] = ZoneRadius()
            link.hear(zone.radius_topic, FLOAT, shapes[zone.name].take)
    return SpeedZones(robot_file.zones, shapes, switches, _switch(link, robot_file.monitor.enable, on=True))


def _counted(link: RosLink, robot_file: RobotFile) -> dict[str, ToggleInput]:
    return {one.name: _switch(link, one.enable, on=one.enabled) for one in robot_file.sources}


def _switch(link: RosLink, topic: str, *, on: bool) -> ToggleInput:
    found = ToggleInput(on)
    if topic:
        link.hear(topic, BOOL, found.take)
    return found


def _driver_type_hash(link: RosLink, robot_file: RobotFile, command_type: str) -> str:
    """Returns the type hash that the driver announces in its liveliness token.

    Raises InputError if the driver uses another type, if there is no driver, or if another node publishes commands.
    """
    if link.form != "rmw_zenoh":
        return hash_of(command_type)
    topic = robot_file.command.topic
    others = link.others_on(topic, PUBLISHER)
    if others:
        raise InputError(
            f"{topic}: {others[0].node} publishes there; let it publish to {robot_file.nominal.topic}, which goes "
            "through the filter: only the gateway may publish to the driver's topic"
        )
    end = time.monotonic() + _DRIVER_SECONDS
    while not (drivers := link.others_on(topic, SUBSCRIBER)):
        if time.monotonic() > end:
            raise InputError(
                f"{topic}: no subscriber after {_DRIVER_SECONDS:.0f} s; start the robot's driver, correct the "
                "topic, or set command.hash to drive without one"
            )
        time.sleep(0.2)
    for driver in drivers:
        if driver.type != command_type:
            raise InputError(
                f"command.type: got '{command_type}', wanted '{driver.type}', the type of {driver.node} on {topic}"
            )
    return drivers[0].hash


if __name__ == "__main__":
    run_process(work, parser(), RealtimePriority.ROBOT)
