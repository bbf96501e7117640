"""The newest of what the robot tells and its policy requests, with its age by this machine's own clock.

The clocks of messages are not believed: a stamp may jump. What counts is when a message arrived, and that its stamp
differs from the one before: a publisher that repeats itself tells nothing new.
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
from safedpa_services.ros_gateway.alone import TWO_SPEAK, PublisherMonitor
from safedpa_services.ros_gateway.echo_monitor import CommandEchoMonitor
from safedpa_services.ros_gateway.localisation import TransformListener
from safedpa_services.ros_gateway.scanner import Scanner

__all__ = ["LatestMessage", "PoseAndTwist", "SensorInputs", "goal_paths", "pose_paths"]

_STAMP = "header.stamp"


@dataclass(frozen=True)
class PoseAndTwist:
    """Where the robot is, and how it moves, in its own frame."""

    x: float
    y: float
    yaw: float
    speed: float
    yaw_rate: float

    @staticmethod
    def of(numbers: tuple[float, ...], ahead: float) -> PoseAndTwist:
        """From what ``pose_paths`` names; the point that is told lies ``ahead`` m of the reference point."""
        x, y, speed, yaw_rate, *quaternion = numbers
        yaw = yaw_of(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
        return PoseAndTwist(x - ahead * math.cos(yaw), y - ahead * math.sin(yaw), yaw, speed, yaw_rate)

    def seen_from(self, frame: tuple[float, float, float]) -> PoseAndTwist:
        """The same in the frame in which its own stands at ``frame``: x, y [m], yaw [rad]."""
        east, north, turn = frame
        cosine, sine = math.cos(turn), math.sin(turn)
        x, y = east + cosine * self.x - sine * self.y, north + sine * self.x + cosine * self.y
        return PoseAndTwist(x, y, self.yaw + turn, self.speed, self.yaw_rate)


def pose_paths() -> tuple[str, ...]:
    """Fields of ``nav_msgs/Odometry``."""
    turn = tuple(f"pose.pose.orientation.{axis}" for axis in "xyzw")
    return ("pose.pose.position.x", "pose.pose.position.y", "twist.twist.linear.x", "twist.twist.angular.z", *turn)


def goal_paths() -> tuple[str, ...]:
    """Fields of ``geometry_msgs/PoseStamped`` that say where to go."""
    return ("pose.position.x", "pose.position.y")


class LatestMessage:
    """The newest message of one topic as numbers; others are gone. Safe between threads."""

    def __init__(
        self, type_name: str, paths: tuple[str, ...], frame: str = "", clock: Callable[[], float] = time.monotonic
    ) -> None:
        definitions = Definitions()
        there = numeric_fields(definitions, type_name)
        self._stamped = _STAMP in there
        alongside = [_STAMP, "header.frame_id"] if self._stamped else []
        self._skip = len(alongside)
        self._decode = Decoder(definitions, type_name, (*alongside, *paths))
        self._frame, self._clock = frame, clock
        self._lock = threading.Lock()
        self._numbers: tuple[float, ...] = ()
        self._changed = -math.inf
        self._stamp = -1
        self._alone = PublisherMonitor()
        self.refused = 0
        """Messages that could not be read, were of another frame, or held what is no number of this world."""
        self.why = ""

    def take(self, data: bytes, alongside: Attachment | None = None) -> None:
        """One message, on the network's thread."""
        at = self._clock()
        if not self._alone.heard(alongside, at):
            self._refuse(TWO_SPEAK)
            return
        try:
            values = self._decode(data)
        except DecodingError as error:
            self._refuse(f"it cannot be read ({error})")
            return
        numbers = tuple(float(value) for value in values[self._skip :])
        if not all(-LARGEST_NUMBER <= number <= LARGEST_NUMBER for number in numbers):
            self._refuse("a number is not finite, or so large that no one believes it")
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
        """The numbers, their age [s] and stamp [ns]; infinitely old before the first, and while two speak."""
        with self._lock:
            if self._alone.doubled(self._clock()):
                return self._numbers, math.inf, self._stamp
            return self._numbers, self._clock() - self._changed, self._stamp


@dataclass(frozen=True)
class SensorInputs:
    """Everything that the gateway hears; what the robot's file does not name is None."""

    odometry: LatestMessage
    driver: CommandEchoMonitor
    nominal: LatestMessage | None = None
    goal: LatestMessage | None = None
    localised: TransformListener | None = None
    scanners: tuple[Scanner, ...] = ()

    @property
    def refused(self) -> int:
        """Messages that were not believed."""
        heard = (self.odometry, self.nominal, self.goal, self.localised, *self.scanners)
        return sum(one.refused for one in heard if one is not None)

    def not_believed(self, scans: Sequence[str]) -> dict[str, str]:
        """Why the newest message of goal, nominal action or a scanner, by its name in ``scans``, was refused, where it was."""
        heard = {"goal": self.goal, "nominal": self.nominal, **dict(zip(scans, self.scanners, strict=True))}
        return {f"{name}_refused": one.why for name, one in heard.items() if one is not None and one.why}
