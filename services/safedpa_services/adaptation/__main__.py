"""``python -m safedpa_services.adaptation``: estimates the latent of each robot's model."""

from __future__ import annotations

import argparse

from safedpa.bus.service.process import RealtimePriority, StopSignal, run_process
from safedpa_services.service_factories import adaptation
from safedpa_services.service_main import serve, service_parser


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Serves until ``stop``; returns the exit code."""
    return serve((adaptation(options),), options, stop)


if __name__ == "__main__":
    run_process(work, service_parser("safedpa-adaptation"), RealtimePriority.ADAPTATION)
