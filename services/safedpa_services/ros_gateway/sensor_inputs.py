"""The newest messages of the robot and its policy, with their age by this machine's clock.

Stamps of messages are not trusted as times, because they may jump. The age counts from the arrival of a message whose
stamp differs from the one before: a repeated message is not newer data.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from safedpa.bus.messages.messages import LARGEST_NUMBER
from safedpa.records.readers.bags.messages import yaw_of
from safedpa.ros.decoding import Decoder, DecodingError
from safedpa.ros.definitions import Definitions, numeric_fields
from safedpa.ros.graph import Attachment
from safedpa_services.ros_gateway.echo_monitor import CommandEchoMonitor
from safedpa_services.ros_gateway.localisation import TransformListener
from safedpa_services.ros_gateway.publisher_monitor import TWO_PUBLISHERS, PublisherMonitor
from safedpa_services.ros_gateway.scanner import Scanner

__all__ = ["LatestMessage", "PoseAndTwist", "SensorInputs", "goal_paths", "pose_paths"]

_STAMP = "header.stamp"


@dataclass(frozen=True)
class PoseAndTwist:
    """Pose of the robot [m, rad], and its velocity in its own frame [m/s, rad/s]."""

    x: float
    y: float
    yaw: float
    speed: float
    yaw_rate: float

    @staticmethod
    def of(numbers: tuple[float, ...], ahead: float) -> PoseAndTwist:
        """Builds it from the fields of ``pose_paths``; the odometry's point is ``ahead`` [m] of the reference point."""
        x, y, speed, yaw_rate, *quaternion = numbers
        yaw = yaw_of(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
        return PoseAndTwist(x - ahead * math.cos(yaw), y - ahead * math.sin(yaw), yaw, speed, yaw_rate)

    def seen_from(self, frame: tuple[float, float, float]) -> PoseAndTwist:
        """Transforms the pose to the parent frame, in which its own frame is at ``frame``: x, y [m], yaw [rad]."""
        east, north, turn = frame
        cosine, sine = math.cos(turn), math.sin(turn)
        x, y = east + cosine * self.x - sine * self.y, north + sine * self.x + cosine * self.y
        return PoseAndTwist(x, y, self.yaw + turn, self.speed, self.yaw_rate)


def pose_paths() -> tuple[str, ...]:
    """Returns the fields to read from ``nav_msgs/Odometry``."""
    turn = tuple(f"pose.pose.orientation.{axis}" for axis in "xyzw")
    return ("pose.pose.position.x", "pose.pose.position.y", "twist.twist.linear.x", "twist.twist.angular.z", *turn)


def goal_paths() -> tuple[str, ...]:
    """Returns the fields to read from the goal, a ``geometry_msgs/PoseStamped``."""
    return ("pose.position.x", "pose.position.y")


class LatestMessage:
    """The newest message of a topic as numbers; thread-safe."""

    def __init__(
        self, type_name: str, paths: tuple[str, ...], frame: str = "", clock: Callable[[], float] = time.monotonic
    ) -> None:
        definitions = Definitions()
        known_fields = numeric_fields(definitions, type_name)
        self._stamped = _STAMP in known_fields
        header = [_STAMP, "header.frame_id"] if self._stamped else []
        self._skip = len(header)
        self._decode = Decoder(definitions, type_name, (*header, *paths))
        self._frame, self._clock = frame, clock
        self._lock = threading.Lock()
        self._numbers: tuple[float, ...] = ()
        self._changed = -math.inf
        self._stamp = -1
        self._publishers = PublisherMonitor()
        self.refused = 0
        """Number of refused messages: unreadable, of another frame, of a second publisher, or with implausible
        numbers."""
        self.why = ""

    def take(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message, on the network's thread."""
        at = self._clock()
        if not self._publishers.accept(attachment, at):
            self._refuse(TWO_PUBLISHERS)
            return
        try:
            values = self._decode(data)
        except DecodingError as error:
            self._refuse(f"it cannot be read ({error})")
            return
        numbers = tuple(float(value) for value in values[self._skip :])
        if not all(-LARGEST_NUMBER <= number <= LARGEST_NUMBER for number in numbers):
            self._refuse("a number is not finite or implausibly large")
            return
        if self._stamped and self._frame and values[1].strip("/") != self._frame.strip("/"):
            self._refuse(f"its frame is '{values[1][:60]}', wanted '{self._frame}'")
            return
        self.why = ""
        stamp = values[0] if self._stamped else 0
        with self._lock:
            same = self._stamped and stamp == self._stamp and stamp != 0
            self._numbers, self._stamp = numbers, stamp
            if not same:
                self._changed = at

    def _refuse(self, why: str) -> None:
        self.refused += 1
        self.why = why

    def read(self) -> tuple[tuple[float, ...], float, int]:
        """Returns the numbers, their age [s] (infinite before the first and with two publishers) and stamp [ns]."""
        with self._lock:
            if self._publishers.has_two(self._clock()):
                return self._numbers, math.inf, self._stamp
            return self._numbers, self._clock() - self._changed, self._stamp


@dataclass(frozen=True)
class SensorInputs:
    """All inputs of the gateway from ROS; None for topics that the robot's file does not name."""

    odometry: LatestMessage
    driver: CommandEchoMonitor
    nominal: LatestMessage | None = None
    goal: LatestMessage | None = None
    localised: TransformListener | None = None
    scanners: tuple[Scanner, ...] = ()

    @property
    def refused(self) -> int:
        """Number of refused messages."""
        inputs = (self.odometry, self.nominal, self.goal, self.localised, *self.scanners)
        return sum(one.refused for one in inputs if one is not None)

    def refusals(self, scans: Sequence[str]) -> dict[str, str]:
        """Returns why the newest messages of goal, nominal action or scanners (named by ``scans``) were refused."""
        inputs = {"goal": self.goal, "nominal": self.nominal, **dict(zip(scans, self.scanners, strict=True))}
        return {f"{name}_refused": one.why for name, one in inputs.items() if one is not None and one.why}
