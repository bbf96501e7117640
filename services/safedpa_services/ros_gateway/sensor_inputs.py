"""The inputs of the gateway from ROS: numbers of the newest messages, transforms and laser scans.

Times are by this machine's clock. Stamps of messages are not trusted as times, because they may jump. The age counts
from the arrival of a message whose stamp differs from the one before: a repeated message is not newer data.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from safedpa.bus.messages.messages import LARGEST_NUMBER
from safedpa.records.readers.bags.messages import yaw_of
from safedpa.ros.decoding import Decoder, DecodingError
from safedpa.ros.definitions import Definitions, numeric_fields
from safedpa.ros.encoding import decode
from safedpa.ros.graph import Attachment
from safedpa.safety.session.plausibility import ClockMonitor
from safedpa_services.ros_gateway.publisher_monitor import TWO_PUBLISHERS, CommandEchoMonitor, PublisherMonitor

SCAN_TYPE = "sensor_msgs/msg/LaserScan"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
_STAMP = "header.stamp"
_NANOSECOND = 1e-9
_MOST_WAITING = 8
"""Scans that are stored between two periods."""
_MOST_RAYS = 8192
_FARTHEST = 1000.0
"""m."""
_LARGEST_ANGLE = 4.0 * math.pi
"""Largest angle of the first ray [rad]."""
Frame = tuple[float, float, float]
"""x, y [m] and yaw [rad]."""


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
        yaw = yaw_of(*quaternion)
        return PoseAndTwist(x - ahead * math.cos(yaw), y - ahead * math.sin(yaw), yaw, speed, yaw_rate)

    def seen_from(self, frame: Frame) -> PoseAndTwist:
        """Transforms the pose to the parent frame, in which its own frame is at ``frame``."""
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


class _Receiver:
    """Receives one topic on the network's thread; refuses messages while two publishers send them."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._publishers = PublisherMonitor()
        self._changed, self._stamp = -math.inf, -1
        self._rate = ClockMonitor()
        self.clock = ""
        """Why the stamps of the messages contradict their arrivals; empty if they do not."""
        self.lag = 0.0
        """Time [s] by which the newest stamp is behind its arrival: the data is at least that old on arrival."""
        self.refused = 0
        """Number of refused messages: unreadable, of another frame, of a second publisher, or with implausible
        numbers."""
        self.why = ""
        """Why the newest message was refused; empty if it was not."""

    def _refuse(self, why: str) -> None:
        self.refused += 1
        self.why = why

    def _repeats(self, stamp: int) -> bool:
        """Whether a message has the stamp [ns] of the one before; 0: it has none."""
        return stamp == self._stamp and stamp != 0

    def _note(self, stamp: int, at: float) -> None:
        """Notes the stamp [ns] and arrival [s] of a usable message; a repeated stamp does not make the data newer."""
        if not self._repeats(stamp):
            self._changed = at
            if stamp != 0:
                self.clock = self._rate.observe(_NANOSECOND * stamp, at) or self._rate.behind
                self.lag = self._rate.lag
        self._stamp, self.why = stamp, ""

    def _age(self) -> float:
        """Age of the newest data [s]; infinite before the first message and with two publishers."""
        at = self._clock()
        return math.inf if self._publishers.has_two(at) else at - self._changed


class LatestMessage(_Receiver):
    """The newest message of a topic as numbers; thread-safe."""

    def __init__(
        self, type_name: str, paths: tuple[str, ...], frame: str = "", clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(clock)
        definitions = Definitions()
        self._stamped = _STAMP in numeric_fields(definitions, type_name)
        header = [_STAMP, "header.frame_id"] if self._stamped else []
        self._skip = len(header)
        self._decode = Decoder(definitions, type_name, (*header, *paths))
        self._frame = frame
        self._numbers: tuple[float, ...] = ()

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
        elif self._stamped and self._frame and values[1].strip("/") != self._frame.strip("/"):
            self._refuse(f"its frame is '{values[1][:60]}', wanted '{self._frame}'")
        else:
            with self._lock:
                self._note(values[0] if self._stamped else 0, at)
                self._numbers = numbers

    def read(self) -> tuple[tuple[float, ...], float, int]:
        """Returns the numbers, their age [s] (infinite before the first and with two publishers) and stamp [ns]."""
        with self._lock:
            return self._numbers, self._age(), self._stamp


@final
class TransformListener(_Receiver):
    """The newest transform from ``frame`` to ``child`` on ``/tf``, published by a localisation."""

    def __init__(self, frame: str, child: str, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(clock)
        self._wanted = (frame.strip("/"), child.strip("/"))
        self._found: Frame = (0.0, 0.0, 0.0)

    def take(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message, on the network's thread. Many nodes publish there; only one may publish this transform."""
        try:
            transforms = decode(TRANSFORMS, data).transforms
        except DecodingError:
            self._refuse("it cannot be read")
            return
        for one in transforms:
            if (one.header.frame_id.strip("/"), one.child_frame_id.strip("/")) == self._wanted:
                self._take(one, attachment)

    def _take(self, one: Any, attachment: Attachment | None) -> None:
        at, place, turn = self._clock(), one.transform.translation, one.transform.rotation
        if not self._publishers.accept(attachment, at):
            self._refuse(TWO_PUBLISHERS)
            return
        found = (float(place.x), float(place.y), yaw_of(turn.x, turn.y, turn.z, turn.w))
        if not all(-LARGEST_NUMBER <= number <= LARGEST_NUMBER for number in found):
            self._refuse("its rotation is invalid, or a number is not finite or implausibly large")
            return
        with self._lock:
            self._note(_nanoseconds(one.header.stamp), at)
            self._found = found

    def read(self) -> tuple[Frame, float]:
        """Returns the odometry's frame in the map, and its age [s], infinite with two publishers."""
        with self._lock:
            return self._found, self._age()


@dataclass(frozen=True)
class ScanReading:
    """One scan: ranges [m] and angles [rad]."""

    arrived: float
    """Time of arrival by this machine's clock [s]."""
    first_angle: float
    angle_step: float
    ranges: tuple[float, ...]
    nearest: float
    farthest: float


@final
class Scanner(_Receiver):
    """Receives ``sensor_msgs/LaserScan`` (ROS REP 117: inf, no return; -inf, too near; NaN, no measurement).

    A finite range below ``range_min``, often 0 for no return, counts as no measurement; -inf becomes ``range_min``.
    """

    def __init__(self, frame: str = "", clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(clock)
        self._frame = frame.strip("/")
        self._waiting: deque[ScanReading] = deque(maxlen=_MOST_WAITING)

    def take(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message, on the network's thread."""
        try:
            scan = decode(SCAN_TYPE, data)
        except DecodingError as error:
            self._refuse(str(error))
            return
        if self._frame and scan.header.frame_id.strip("/") != self._frame:
            self._refuse(f"its frame is '{scan.header.frame_id[:60]}', wanted '{self._frame}'")
            return
        at, stamp = self._clock(), _nanoseconds(scan.header.stamp)
        if not self._publishers.accept(attachment, at):
            self._refuse(TWO_PUBLISHERS)
        elif not self._repeats(stamp):
            reading = _reading(scan, at)
            if reading is None:
                self._refuse("its angles or limits are invalid, or it has no rays or too many")
            else:
                self._note(stamp, at)
                self._waiting.append(reading)

    def take_all(self) -> list[ScanReading]:
        """Returns the scans since the last call, oldest first."""
        found = []
        while self._waiting:
            found.append(self._waiting.popleft())
        return found


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _reading(scan: Any, arrived: float) -> ScanReading | None:
    first, step = float(scan.angle_min), float(scan.angle_increment)
    nearest, farthest = float(scan.range_min), float(scan.range_max)
    count = len(scan.ranges)
    if not (abs(first) <= _LARGEST_ANGLE and math.isfinite(step) and step and 0.0 <= nearest < farthest <= _FARTHEST):
        return None
    if not 0 < count <= _MOST_RAYS or count * abs(step) > 2.0 * math.pi + 2.0 * abs(step):
        return None
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    nothing = np.isnan(ranges) | (np.isfinite(ranges) & (ranges < nearest))
    clean = np.where(nothing, -1.0, np.clip(ranges, nearest, farthest))
    return ScanReading(arrived, first, step, tuple(clean.tolist()), nearest, farthest)


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
