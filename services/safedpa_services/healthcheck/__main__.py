"""``python -m safedpa_services.healthcheck SERVICE``: exit code 0 when it makes progress, 1 when it does not."""

from __future__ import annotations

import argparse
import sys

from safedpa.bus.loop.process import Stop, add_bus_options, bus_from, run_process
from safedpa_services.healthcheck.healthcheck import HealthCheck


def health_parser() -> argparse.ArgumentParser:
    """The options of the health check."""
    parser = argparse.ArgumentParser(prog="safedpa-healthcheck", description="does a service make progress?")
    add_bus_options(parser)
    parser.add_argument("service", help="robot, adaptation, policy, safety_filter, recorder or dashboard")
    parser.add_argument("--robot", default="*", help="hear the heartbeats for this robot alone")
    parser.add_argument("--seconds", type=float, default=2.0, help="how long to wait for the proof")
    return parser


def work(options: argparse.Namespace, stop: Stop) -> int:
    """Listens until the service proved itself or the time is over; returns the exit code."""
    del stop  # it ends by itself within --seconds
    with bus_from(options) as bus:
        reason = HealthCheck(bus, options.service, options.robot).run(options.seconds)
    if reason:
        sys.stdout.write(f"{reason}\n")
    return 1 if reason else 0


if __name__ == "__main__":
    run_process(work, health_parser())
