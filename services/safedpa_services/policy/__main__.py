"""``python -m safedpa_services.policy``: wishes for actions that lead every robot of a fleet to its goal."""

from __future__ import annotations

import argparse

from safedpa.bus.process import Stop, run_process
from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa_services.serving import serve, service_parser


def work(options: argparse.Namespace, stop: Stop) -> int:
    """Serves until ``stop``; returns the exit code."""
    return serve(PolicyNode(load_model(options.model)), options, stop)


if __name__ == "__main__":
    run_process(work, service_parser("safedpa-policy"))
