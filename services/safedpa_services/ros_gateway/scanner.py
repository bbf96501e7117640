"""A laser scanner of the robot: its scans as those of our bus, by this machine's clock."""

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
from safedpa_services.ros_gateway.alone import TWO_SPEAK, PublisherMonitor

__all__ = ["SCAN_TYPE", "ScanReading", "Scanner"]

SCAN_TYPE = "sensor_msgs/msg/LaserScan"
_MOST_WAITING = 8
"""Scans that are kept between two periods."""
_MOST_RAYS = 8192
_FARTHEST = 1000.0
"""m."""
_LARGEST_ANGLE = 4.0 * math.pi
"""rad of a first ray."""


@dataclass(frozen=True)
class ScanReading:
    """One scan, without its time: ranges in m, angles in rad."""

    arrived: float
    """s by this machine's clock."""
    first_angle: float
    angle_step: float
    ranges: tuple[float, ...]
    nearest: float
    farthest: float


@final
class Scanner:
    """Hears ``sensor_msgs/LaserScan`` (ROS REP 117: infinite, nothing came back; minus infinite, too near; NaN, none).

    What is nearer than ``range_min``, often 0 where nothing came back, is no measurement; minus infinite stands at
    ``range_min``.
    """

    def __init__(self, frame: str = "", clock: Callable[[], float] = time.monotonic) -> None:
        self._frame, self._clock = frame.strip("/"), clock
        self._waiting: deque[ScanReading] = deque(maxlen=_MOST_WAITING)
        self._stamp: Any = None
        self._alone = PublisherMonitor()
        self.refused = 0
        self.why = ""

    def take(self, data: bytes, alongside: Attachment | None = None) -> None:
        """One message, on the network's thread."""
        try:
            scan = decode(SCAN_TYPE, data)
        except DecodingError as error:
            self._refuse(str(error))
            return
        if self._frame and scan.header.frame_id.strip("/") != self._frame:
            self._refuse(f"its frame is '{scan.header.frame_id[:60]}', wanted '{self._frame}'")
            return
        at = self._clock()
        if not self._alone.heard(alongside, at):
            self._refuse(TWO_SPEAK)
            return
        stamp = (scan.header.stamp.sec, scan.header.stamp.nanosec)
        if stamp == self._stamp and stamp != (0, 0):
            return  # a publisher that repeats itself tells nothing new
        turn = _turn(scan, at)
        if turn is None:
            self._refuse("its angles or limits are no numbers, or it has no ray or too many")
            return
        self._stamp, self.why = stamp, ""
        self._waiting.append(turn)

    def _refuse(self, why: str) -> None:
        self.refused += 1
        self.why = why

    def taken(self) -> list[ScanReading]:
        """What came since the last call, oldest first."""
        found = []
        while self._waiting:
            found.append(self._waiting.popleft())
        return found


def _turn(scan: Any, arrived: float) -> ScanReading | None:
    first, step = float(scan.angle_min), float(scan.angle_increment)
    nearest, farthest = float(scan.range_min), float(scan.range_max)
    count = len(scan.ranges)
    if not (abs(first) <= _LARGEST_ANGLE and math.isfinite(step) and step and 0.0 <= nearest < farthest <= _FARTHEST):
        return None
    if not 0 < count <= _MOST_RAYS or count * abs(step) > 2.0 * math.pi + 2.0 * abs(step):
        return None
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    nothing = np.isnan(ranges) | (np.isfinite(ranges) & (ranges < nearest))
    retained = np.where(nothing, -1.0, np.clip(ranges, nearest, farthest))
    return ScanReading(arrived, first, step, tuple(retained.tolist()), nearest, farthest)
