"""Receives the scans of a laser scanner of the robot, stamped by this machine's clock."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from safedpa.ros.decoding import DecodingError
from safedpa.ros.encoding import decode
from safedpa.ros.graph import Attachment
from safedpa_services.ros_gateway.publisher_monitor import TWO_PUBLISHERS, PublisherMonitor

__all__ = ["SCAN_TYPE", "ScanReading", "Scanner"]

SCAN_TYPE = "sensor_msgs/msg/LaserScan"
_MOST_WAITING = 8
"""Scans that are stored between two periods."""
_MOST_RAYS = 8192
_FARTHEST = 1000.0
"""m."""
_LARGEST_ANGLE = 4.0 * math.pi
"""Largest angle of the first ray [rad]."""


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
class Scanner:
    """Receives ``sensor_msgs/LaserScan`` (ROS REP 117: inf, no return; -inf, too near; NaN, no measurement).

    A finite range below ``range_min``, often 0 for no return, counts as no measurement; -inf becomes ``range_min``.
    """

    def __init__(self, frame: str = "", clock: Callable[[], float] = time.monotonic) -> None:
        self._frame, self._clock = frame.strip("/"), clock
        self._waiting: deque[ScanReading] = deque(maxlen=_MOST_WAITING)
        self._stamp: Any = None
        self._publishers = PublisherMonitor()
        self.refused = 0
        self.why = ""

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
        at = self._clock()
        if not self._publishers.accept(attachment, at):
            self._refuse(TWO_PUBLISHERS)
            return
        stamp = (scan.header.stamp.sec, scan.header.stamp.nanosec)
        if stamp == self._stamp and stamp != (0, 0):
            return  # a repeated stamp does not make the data newer
        reading = _reading(scan, at)
        if reading is None:
            self._refuse("its angles or limits are invalid, or it has no rays or too many")
            return
        self._stamp, self.why = stamp, ""
        self._waiting.append(reading)

    def _refuse(self, why: str) -> None:
        self.refused += 1
        self.why = why

    def take_all(self) -> list[ScanReading]:
        """Returns the scans since the last call, oldest first."""
        found = []
        while self._waiting:
            found.append(self._waiting.popleft())
        return found


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
