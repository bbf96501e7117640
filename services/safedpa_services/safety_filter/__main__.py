"""``python -m safedpa_services.safety_filter``: turns wishes into actions that keep every robot of a fleet safe."""

from __future__ import annotations

import argparse
import dataclasses

from safedpa.bus.process import Stop, run_process
from safedpa.dynamics import load_model
from safedpa.safety import FilterSettings, load_settings
from safedpa.safety.node import SafetyFilterNode
from safedpa_services.serving import serve, service_parser


def work(options: argparse.Namespace, stop: Stop) -> int:
    """Serves until ``stop``; returns the exit code."""
    settings = load_settings(options.settings) if options.settings else FilterSettings()
    settings = dataclasses.replace(settings, enabled=settings.enabled and not options.off)
    return serve(SafetyFilterNode(load_model(options.model), settings), options, stop)


if __name__ == "__main__":
    parser = service_parser("safedpa-safety-filter")
    parser.add_argument("--settings", default="", metavar="FILE.toml", help="settings of the filter")
    parser.add_argument("--off", action="store_true", help="hand wishes on unchecked; every verdict says so")
    run_process(work, parser)
