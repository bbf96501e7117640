"""``python -m safedpa_services.safety_filter``: corrects nominal actions so that each robot stays safe."""

from __future__ import annotations

import argparse

from safedpa.bus.service.process import RealtimePriority, StopSignal, run_process
from safedpa_services.service_factories import add_filter_options, safety_filter
from safedpa_services.service_main import serve, service_parser


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Serves until ``stop``; returns the exit code."""
    return serve((safety_filter(options),), options, stop)


if __name__ == "__main__":
    parser = service_parser("safedpa-safety-filter")
    add_filter_options(parser)
    run_process(work, parser, RealtimePriority.FILTER)
