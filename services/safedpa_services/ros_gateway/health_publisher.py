"""Publishes diagnostics and markers in ROS: verdicts, the state of the gateway, and the predicted path."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, final

from safedpa.bus.messages.messages import VerdictMessage
from safedpa.ros.encoding import stamp_of
from safedpa.ros.face import AbstractFace
from safedpa.ros.link import RosPublisher
from safedpa.ros.outgoing import diagnostics_of, gateway_diagnostics, path_marker

_MARKER_SECONDS = 0.1
"""Shortest time between two markers [s]."""


@final
class HealthPublisher:
    """Publishes on the topics for diagnostics and markers, if the robot's file names them."""

    def __init__(
        self,
        robot: str,
        frame: str,
        face: AbstractFace,
        diagnostics: RosPublisher | None,
        markers: RosPublisher | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._robot, self._frame, self._face, self._clock = robot, frame, face, clock
        self._diagnostics, self._markers = diagnostics, markers
        self._next_marker = clock()

    def head(self, nanoseconds: int = 0) -> dict[str, Any]:
        """Returns a message header in the frame of the surroundings, stamped with the given time (0: now)."""
        return {"stamp": stamp_of(nanoseconds or time.time_ns()), "frame_id": self._frame}

    def verdict(self, verdict: VerdictMessage) -> None:
        """Publishes a verdict of the filter, and the predicted path."""
        if self._diagnostics is not None:
            self._diagnostics.put(diagnostics_of(self.head(), self._robot, verdict))
        if self._markers is not None and verdict.predicted and self._clock() >= self._next_marker:
            self._next_marker = self._clock() + _MARKER_SECONDS
            try:
                places = [self._face.planar(row)[:2] for row in verdict.predicted]
            except IndexError:  # states of another model: a marker must not end the drive
                return
            self._markers.put({"markers": [path_marker(self.head(), places)]})

    def gateway(self, why: str, facts: dict[str, str]) -> None:
        """Publishes the state of the gateway; ``why`` it brakes, empty if the filter drives."""
        if self._diagnostics is not None:
            self._diagnostics.put(gateway_diagnostics(self.head(), self._robot, why, facts))
