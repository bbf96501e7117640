"""``python -m safedpa_services.perception``: publishes what is around each robot, from its laser scans."""

from __future__ import annotations

import argparse

from safedpa.bus.service.process import RealtimePriority, StopSignal, run_process
from safedpa_services.service_factories import add_perception_options, perception
from safedpa_services.service_main import serve, service_parser


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Serves until ``stop``; returns the exit code."""
    return serve((perception(options),), options, stop)


if __name__ == "__main__":
    parser = service_parser("safedpa-perception")
    add_perception_options(parser)
    run_process(work, parser, RealtimePriority.POLICY)
