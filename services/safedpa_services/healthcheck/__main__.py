"""``python -m safedpa_services.healthcheck SERVICE``: exit code 0 when it makes progress, 1 when it does not.

A service is judged by its heartbeats, which its working loop itself sends: a process that hangs sends none. Healthy is
one of which two heartbeats of one process come within the time given, neither says ``failing``, and, where the later
one says that it works for a robot, the steps counted have grown in between.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

from safedpa.bus import HEALTH, Bus, HealthMessage, ReceivedMessage
from safedpa.bus.service.process import StopSignal, add_bus_options, bus_from_options, run_process


class HealthCheck:
    """Hears the heartbeats of ``service`` from now on; ``robot`` limits them to one robot's."""

    def __init__(self, bus: Bus, service: str, robot: str = "*", clock: Callable[[], float] = time.monotonic) -> None:
        self._service = service
        self._clock = clock
        self._inbox = bus.inbox((HEALTH,), robot, keep_all=True)
        self._first: dict[tuple[str, int], HealthMessage] = {}
        self._reason = ""

    def run(self, seconds: float) -> str:
        """Why the service is not healthy, in words, or nothing as soon as it proved that it is."""
        self._reason = f"{self._service}: no two heartbeats within {seconds:g} s"
        end = self._clock() + seconds
        while True:
            rest = end - self._clock()
            for item in self._inbox.take(max(0.0, rest)):
                if isinstance(item, ReceivedMessage) and self._proves(item):
                    return ""
            if rest <= 0.0:
                return self._reason

    def _proves(self, item: ReceivedMessage) -> bool:
        heartbeat = item.message
        if not isinstance(heartbeat, HealthMessage) or heartbeat.service != self._service:
            return False
        first = self._first.setdefault((item.key, heartbeat.pid), heartbeat)
        if heartbeat.state == "failing":
            self._reason = f"{self._service}: failing{f', {heartbeat.detail}' if heartbeat.detail else ''}"
            return False
        if heartbeat.publish_time <= first.publish_time:
            return False
        if heartbeat.state == "running" and heartbeat.steps <= first.steps:
            self._reason = f"{self._service}: alive, but it made no step after step {first.steps}"
            return False
        return True


def health_parser() -> argparse.ArgumentParser:
    """The options of the health check."""
    parser = argparse.ArgumentParser(prog="safedpa-healthcheck", description="does a service make progress?")
    add_bus_options(parser)
    parser.add_argument("service", help="robot, adaptation, policy, safety_filter, recorder or dashboard")
    parser.add_argument("--robot", default="*", help="hear the heartbeats for this robot alone")
    parser.add_argument("--seconds", type=float, default=2.0, help="how long to wait for the proof")
    return parser


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Listens until the service proved itself or the time is over; returns the exit code."""
    del stop  # it ends by itself within --seconds
    with bus_from_options(options) as bus:
        reason = HealthCheck(bus, options.service, options.robot).run(options.seconds)
    if reason:
        sys.stdout.write(f"{reason}\n")
    return 1 if reason else 0


if __name__ == "__main__":
    run_process(work, health_parser())
