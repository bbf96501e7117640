"""The inputs of the gateway from ROS: numbers of the newest messages, transforms and footprints.

Times are by this machine's clock. Stamps of messages are not trusted as times, because they may jump. The age counts
from the arrival of a message whose stamp differs from the one before: a repeated message is not newer data.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, final

from safedpa.arrays import FloatArray
from safedpa.bus.messages.messages import LARGEST_NUMBER
from safedpa.records.readers.bags.messages import yaw_of
from safedpa.ros.decoding import Decoder, DecodingError
from safedpa.ros.definitions import Definitions, numeric_fields
from safedpa.ros.encoding import decode
from safedpa.ros.graph import Attachment
from safedpa.ros.sensor_messages import POLYGON, corners_of, covering_capsule
from safedpa.safety.session.plausibility import ClockMonitor
from safedpa_services.ros_gateway.publisher_monitor import TWO_PUBLISHERS, PublisherMonitor

TRANSFORMS = "tf2_msgs/msg/TFMessage"
_STAMP = "header.stamp"
_NANOSECOND = 1e-9
_MOST_FOOTPRINTS = 200
"""Footprints that are stored: 10 s at 20 Hz."""
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
    aside: float = 0.0
    """Velocity to the left [m/s]."""

    @staticmethod
    def of(numbers: tuple[float, ...], ahead: float) -> PoseAndTwist:
        """Builds it from the fields of ``pose_paths``; the odometry's point is ``ahead`` [m] of the reference point."""
        x, y, speed, yaw_rate, *quaternion = numbers[:8]
        aside = (numbers[8] if len(numbers) > 8 else ahead * yaw_rate) - ahead * yaw_rate
        yaw = yaw_of(*quaternion)
        return PoseAndTwist(x - ahead * math.cos(yaw), y - ahead * math.sin(yaw), yaw, speed, yaw_rate, aside)

    def seen_from(self, frame: Frame) -> PoseAndTwist:
        """Transforms the pose to the parent frame, in which its own frame is at ``frame``."""
        east, north, turn = frame
        cosine, sine = math.cos(turn), math.sin(turn)
        x, y = east + cosine * self.x - sine * self.y, north + sine * self.x + cosine * self.y
        return PoseAndTwist(x, y, self.yaw + turn, self.speed, self.yaw_rate, self.aside)


def pose_paths() -> tuple[str, ...]:
    """Returns the fields to read from ``nav_msgs/Odometry``."""
    turn = tuple(f"pose.pose.orientation.{axis}" for axis in "xyzw")
    velocity = ("twist.twist.linear.x", "twist.twist.angular.z")
    return ("pose.pose.position.x", "pose.pose.position.y", *velocity, *turn, "twist.twist.linear.y")


def goal_paths() -> tuple[str, ...]:
    """Returns the fields to read from the goal, a ``geometry_msgs/PoseStamped``."""
    return ("pose.position.x", "pose.position.y")


class Receiver:
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


class LatestMessage(Receiver):
    """The newest message of a topic as numbers; thread-safe."""

    def __init__(
        self,
        type_name: str,
        paths: tuple[str, ...],
        frame: str = "",
        clock: Callable[[], float] = time.monotonic,
        publishers: PublisherMonitor | None = None,
    ) -> None:
        super().__init__(clock)
        self._publishers = publishers or self._publishers
        self.type = type_name
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
class NominalInput:
    """The newest nominal action of any of several types on one topic; two publishers are refused whatever their types.

    :param types: message types and the fields to read, the expected type first
    """

    def __init__(self, types: Mapping[str, tuple[str, ...]], clock: Callable[[], float] = time.monotonic) -> None:
        publishers = PublisherMonitor()
        self.inputs = {kind: LatestMessage(kind, paths, "", clock, publishers) for kind, paths in types.items()}

    @property
    def _newest(self) -> LatestMessage:
        return min(self.inputs.values(), key=lambda one: one.read()[1])

    @property
    def type(self) -> str:
        """Type of the newest message."""
        return self._newest.type

    @property
    def refused(self) -> int:
        """Number of refused messages."""
        return sum(one.refused for one in self.inputs.values())

    @property
    def why(self) -> str:
        """Why the newest message was refused; empty if it was not."""
        return next((one.why for one in self.inputs.values() if one.why), "")

    def read(self) -> tuple[tuple[float, ...], float, int]:
        """As ``LatestMessage.read``, of the newest message."""
        return self._newest.read()


@final
class FootprintInput(Receiver):
    """The footprint as a capsule that covers the newest polygons (``geometry_msgs/PolygonStamped``).

    :param to_body: transform (4, 4) from a frame to the body; raises DecodingError
    :param hold: time [s] for which the largest extents count
    """

    def __init__(
        self, to_body: Callable[[str], FloatArray], hold: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(clock)
        self._to_body, self._hold = to_body, hold
        self._heard: deque[tuple[float, tuple[float, float, float]]] = deque(maxlen=_MOST_FOOTPRINTS)

    def take(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message, on the network's thread."""
        at = self._clock()
        if not self._publishers.accept(attachment, at):
            self._refuse(TWO_PUBLISHERS)
            return
        try:
            message = decode(POLYGON, data)
            matrix = self._to_body(message.header.frame_id)
            corners = corners_of(message) @ matrix[:3, :3].T + matrix[:3, 3]
        except DecodingError as error:
            self._refuse(str(error))
            return
        with self._lock:
            self._note(0, at)
            self._heard.append((at, covering_capsule(corners[:, :2])))

    def read(self) -> tuple[tuple[float, ...], float]:
        """Returns rear, front and radius [m], rounded up to cm, and the age [s] of the newest."""
        with self._lock:
            age = self._age()
            recent = [size for at, size in self._heard if self._clock() - at <= self._hold] or [
                size for _, size in list(self._heard)[-1:]
            ]
        if not recent:
            return (), math.inf
        rear, front, radius = (math.ceil(100.0 * max(column) - 1e-6) / 100.0 for column in zip(*recent, strict=True))
        return (max(rear, -front), front, radius), age


@final
class TransformListener(Receiver):
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
            self._note(nanoseconds(one.header.stamp), at)
            self._found = found

    def read(self) -> tuple[Frame, float]:
        """Returns the odometry's frame in the map, and its age [s], infinite with two publishers."""
        with self._lock:
            return self._found, self._age()


def nanoseconds(stamp: Any) -> int:
    """Returns a ``builtin_interfaces/Time`` as nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
