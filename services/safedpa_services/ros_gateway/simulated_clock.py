"""Simulated time: a clock that follows ``rosgraph_msgs/Clock``."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import final

from safedpa.ros.decoding import Decoder, DecodingError
from safedpa.ros.definitions import Definitions
from safedpa.ros.graph import Attachment

__all__ = ["CLOCK", "SimulatedClock"]

CLOCK = "rosgraph_msgs/msg/Clock"
_LONGEST_STEP = 1.0
"""s of simulated time between two messages; a longer step is a jump, as after loading a world."""


@final
class SimulatedClock:
    """Time [s] that advances as ``/clock`` does; call it to read it.

    While no message arrives for ``largest_gap`` [s], it runs on with the machine's own clock and ``why`` is not empty,
    so that a paused simulation brakes the robot and does not block the gateway. A step backwards or of more than 1 s
    does not move it; ``restarts`` counts them, since the robot is then another one.
    """

    def __init__(self, largest_gap: float = 0.5, clock: Callable[[], float] = time.monotonic) -> None:
        self._gap, self._clock, self._lock = largest_gap, clock, threading.Lock()
        self._reading, self._at = 0.0, clock()
        self._decode = Decoder(Definitions(), CLOCK, ("clock",))
        self._stamp: int | None = None
        self.refused, self.restarts = 0, 0

    def take(self, data: bytes, attachment: Attachment | None = None) -> None:
        """Takes a message, on the network's thread."""
        del attachment
        try:
            (stamp,) = self._decode(data)
        except DecodingError:
            self.refused += 1
            return
        with self._lock:
            before, now = self._stamp, self._clock()
            step = 0.0 if before is None else 1e-9 * (stamp - before)
            if not 0.0 <= step <= _LONGEST_STEP:
                self.restarts += 1
                step = 0.0
            self._reading = max(self._now(now), self._reading + step)
            self._stamp, self._at = stamp, now

    def __call__(self) -> float:
        """Returns the time [s] since the start."""
        with self._lock:
            return self._now(self._clock())

    def _now(self, now: float) -> float:
        return self._reading + max(0.0, now - self._at - self._gap)

    @property
    def nanoseconds(self) -> int:
        """The newest simulated time [ns], for stamps; 0 before the first message."""
        with self._lock:
            return self._stamp or 0

    @property
    def why(self) -> str:
        """Why simulated time counts as stopped; empty while it runs."""
        with self._lock:
            silent = self._clock() - self._at
            if self._stamp is None:
                return "no simulated time has arrived yet"
            return f"simulated time has stopped for {silent:.2f} s" if silent > self._gap else ""
