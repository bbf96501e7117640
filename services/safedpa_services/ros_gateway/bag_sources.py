"""The sensors of a robot file in a bag: the same messages, conversions and refusals as while driving."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

from safedpa.errors import InputError, RunError
from safedpa.extras import need
from safedpa_services.ros_gateway.robot_file import RobotFile
from safedpa_services.ros_gateway.sensor_inputs import TRANSFORMS, LatestMessage, TransformListener, pose_paths
from safedpa_services.ros_gateway.sources import SourceReader, SourceReading, SourceReceiver, body_frames

__all__ = ["SourceSummary", "read_sources", "summarize_sources"]

_INFO = "sensor_msgs/msg/CameraInfo"


@final
@dataclass
class SourceSummary:
    """What a bag has of one source; times are those of receipt [s]."""

    messages: int = 0
    used: int = 0
    longest_gap: float = 0.0
    measured: float = 0.0
    """Mean share of the rays with a return or with free space."""
    reasons: Counter[str] = field(default_factory=Counter)
    """Number of messages refused, by reason."""


@final
class _BagClock:
    """Time of receipt of the message that is read [s]."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def _takers(
    robot_file: RobotFile, clock: _BagClock
) -> tuple[dict[tuple[str, str], list[Callable[[bytes], None]]], dict[str, SourceReceiver]]:
    """Receivers by topic and type, and the receivers of the sources by name."""
    odometry = LatestMessage(robot_file.odometry.type, pose_paths(), robot_file.wire.frame, clock)
    localised = None
    takers: dict[tuple[str, str], list[Callable[[bytes], None]]] = {}

    def add(topic: str, kind: str, take: Callable[[bytes], None]) -> None:
        takers.setdefault((f"/{topic.strip('/')}", kind), []).append(take)

    add(robot_file.odometry.topic, robot_file.odometry.type, odometry.take)
    if robot_file.localisation.topic:
        localised = TransformListener(robot_file.localisation.frame, robot_file.wire.frame, clock)
        add(robot_file.localisation.topic, TRANSFORMS, localised.take)
    frames = body_frames(robot_file, odometry, localised, clock)
    add(robot_file.frames.fixed, TRANSFORMS, frames.take_fixed)
    add(robot_file.frames.moving, TRANSFORMS, frames.take_moving)
    sources = {}
    for topic in robot_file.sensors:
        reader = SourceReader(topic, robot_file.exclusions, frames, robot_file.wire.frame)
        sources[topic.name] = SourceReceiver(reader, clock)
        add(topic.topic, topic.type, sources[topic.name].take)
        if topic.info:
            add(topic.info, _INFO, sources[topic.name].take_info)
    return takers, sources


def read_sources(bag: Path, robot_file: RobotFile) -> Iterator[tuple[float, str, SourceReading | str]]:
    """Yields time of receipt [s], name of the source, and its reading or the reason why it is refused.

    The bag is a rosbag2 (folder or MCAP file). Raises RunError if it cannot be read, and InputError for a robot without
    sources.
    """
    need("ros", what="reading ROS logs")
    from rosbags.highlevel import AnyReader
    from rosbags.highlevel.anyreader import AnyReaderError

    if not robot_file.sensors:
        raise InputError("the robot file has no [[scans]] and no [[sources]]; wanted at least one")
    clock = _BagClock()
    takers, sources = _takers(robot_file, clock)
    named = {(f"/{one.topic.strip('/')}", one.type): one.name for one in robot_file.sensors}
    try:
        with AnyReader([bag]) as reader:
            wanted = [line for line in reader.connections if (line.topic, line.msgtype) in takers]
            for line, at, data in reader.messages(connections=wanted):
                clock.now = 1e-9 * at
                for take in takers[line.topic, line.msgtype]:
                    take(bytes(data))
                name = named.get((line.topic, line.msgtype))
                if name is None:
                    continue
                found = sources[name].take_all()
                if found or sources[name].why:
                    yield clock.now, name, found[0] if found else sources[name].why
    except (AnyReaderError, OSError, ValueError, KeyError, RuntimeError) as error:
        raise RunError(f"{bag}: cannot be read as a rosbag2 ({str(error)[:80]}); name its folder") from error


def summarize_sources(bag: Path, robot_file: RobotFile) -> dict[str, SourceSummary]:
    """Returns a summary of each source of the robot file; raises as ``read_sources``."""
    found = {one.name: SourceSummary() for one in robot_file.sensors}
    last: dict[str, float] = {}
    for at, name, reading in read_sources(bag, robot_file):
        summary = found[name]
        summary.messages += 1
        if isinstance(reading, str):
            summary.reasons[reading] += 1
            continue
        summary.longest_gap = max(summary.longest_gap, at - last.get(name, at))
        last[name] = at
        rays = reading.rays
        free = rays.free or (0.0,) * len(rays.ranges)
        seen = sum(0.0 <= one < rays.farthest or way > 0.0 for one, way in zip(rays.ranges, free, strict=True))
        summary.measured += (seen / len(rays.ranges) - summary.measured) / (summary.used + 1)
        summary.used += 1
    for summary in found.values():
        summary.longest_gap = summary.longest_gap if summary.used else math.inf
    return found
