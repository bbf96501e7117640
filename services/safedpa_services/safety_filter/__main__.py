"""``python -m safedpa_services.safety_filter``: turns wishes into actions that keep every robot of a fleet safe."""

from __future__ import annotations

import argparse
import dataclasses
import sys

from safedpa.bus.process import Stop, run_process
from safedpa.dynamics import load_model
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.shipped import margin_for, settings_named
from safedpa_services.serving import serve, service_parser


def work(options: argparse.Namespace, stop: Stop) -> int:
    """Serves until ``stop``; returns the exit code."""
    settings = settings_named(options.settings)
    settings = dataclasses.replace(settings, enabled=settings.enabled and not options.off)
    model = load_model(options.model)
    margin = margin_for(model, options.margin)
    if margin is None:
        sys.stderr.write("margin: none was calibrated for this model; the settings' epsilon stands in for it\n")
    return serve(SafetyFilterNode(model, settings, margin), options, stop)


if __name__ == "__main__":
    parser = service_parser("safedpa-safety-filter")
    parser.add_argument("--settings", default="car", metavar="FILE.toml", help="settings: a file or a shipped name")
    parser.add_argument("--margin", default="", metavar="FILE.toml", help="from 'safedpa calibrate'")
    parser.add_argument("--off", action="store_true", help="hand wishes on unchecked; every verdict says so")
    run_process(work, parser)
