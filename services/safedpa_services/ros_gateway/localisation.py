"""Receives the transform from the map to the odometry's frame, published by a localisation."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any, final

from safedpa.bus.messages.messages import LARGEST_NUMBER
from safedpa.records.readers.bags.messages import yaw_of
from safedpa.ros.decoding import DecodingError
from safedpa.ros.encoding import decode
from safedpa.ros.graph import Attachment
from safedpa_services.ros_gateway.publisher_monitor import TWO_PUBLISHERS, PublisherMonitor

__all__ = ["TRANSFORMS", "TransformListener"]

TRANSFORMS = "tf2_msgs/msg/TFMessage"
Frame = tuple[float, float, float]


@final
class TransformListener:
    """The newest transform from ``frame`` to ``child`` on ``/tf``, with its age by this machine's clock."""

    def __init__(self, frame: str, child: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._wanted, self._clock = (frame.strip("/"), child.strip("/")), clock
        self._lock = threading.Lock()
        self._found: Frame = (0.0, 0.0, 0.0)
        self._at, self._stamp = -math.inf, (0, 0)
        self._publishers = PublisherMonitor()
        self.refused = 0
        self.why = ""

    def take(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message, on the network's thread. Many nodes publish there; only one may publish this transform."""
        try:
            transforms = decode(TRANSFORMS, data).transforms
        except DecodingError:
            self._refuse("it cannot be read")
            return
        for one in transforms:
            if (one.header.frame_id.strip("/"), one.child_frame_id.strip("/")) != self._wanted:
                continue
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
        stamp = (int(one.header.stamp.sec), int(one.header.stamp.nanosec))
        with self._lock:
            same = stamp == self._stamp and stamp != (0, 0)  # a repeated stamp does not make the data newer
            self._found, self._stamp, self.why = found, stamp, ""
            if not same:
                self._at = at

    def _refuse(self, why: str) -> None:
        self.refused += 1
        self.why = why

    def read(self) -> tuple[Frame, float]:
        """Returns x, y [m], yaw [rad] of odometry's frame in the map, and its age [s], infinite with two publishers."""
        with self._lock:
            at = self._clock()
            return self._found, math.inf if self._publishers.has_two(at) else at - self._at
