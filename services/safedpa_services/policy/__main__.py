"""``python -m safedpa_services.policy``: requests actions that lead each robot to its goal."""

from __future__ import annotations

import argparse

from safedpa.bus.service.process import RealtimePriority, StopSignal, run_process
from safedpa_services.service_factories import add_policy_options, policy
from safedpa_services.service_main import serve, service_parser


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Serves until ``stop``; returns the exit code."""
    return serve((policy(options),), options, stop)


if __name__ == "__main__":
    parser = service_parser("safedpa-policy")
    add_policy_options(parser)
    run_process(work, parser, RealtimePriority.POLICY)
