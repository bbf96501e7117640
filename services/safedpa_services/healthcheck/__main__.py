"""``python -m safedpa_services.healthcheck SERVICE``: exit code 0 if the service makes progress, 1 if not.

A service is judged by its heartbeats, which its main loop sends: a hanging process sends none. It is healthy if two
heartbeats of one process arrive within the given time, neither is ``failing``, and, if it serves a robot, the number of
steps grew in between.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

from safedpa.bus import HEALTH, Bus, HealthMessage, ReceivedMessage
from safedpa.bus.service.process import StopSignal, add_bus_options, bus_from_options, run_process


class HealthCheck:
    """Observes the heartbeats of ``service`` from its construction on; ``robot`` limits them to one robot."""

    def __init__(self, bus: Bus, service: str, robot: str = "*", clock: Callable[[], float] = time.monotonic) -> None:
        self._service = service
        self._clock = clock
        self._inbox = bus.inbox((HEALTH,), robot, keep_all=True)
        self._first: dict[tuple[str, int], HealthMessage] = {}
        self._reason = ""

    def run(self, seconds: float) -> str:
        """Returns why the service is not healthy, after ``seconds``; an empty string as soon as it is healthy."""
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
            self._reason = f"{self._service}: alive, but made no step after step {first.steps}"
            return False
        return True


def health_parser() -> argparse.ArgumentParser:
    """Returns a parser with the options of the health check."""
    parser = argparse.ArgumentParser(prog="safedpa-healthcheck", description="check that a service makes progress")
    add_bus_options(parser)
    parser.add_argument("service", help="robot, adaptation, policy, safety_filter, recorder or dashboard")
    parser.add_argument("--robot", default="*", help="only heartbeats about this robot")
    parser.add_argument("--seconds", type=float, default=2.0, help="how long to wait for two heartbeats")
    return parser


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Waits until the service is known to be healthy or the time is over; returns the exit code."""
    del stop  # it ends by itself within --seconds
    with bus_from_options(options) as bus:
        reason = HealthCheck(bus, options.service, options.robot).run(options.seconds)
    if reason:
        sys.stdout.write(f"{reason}\n")
    return 1 if reason else 0


if __name__ == "__main__":
    run_process(work, health_parser())
