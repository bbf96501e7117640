"""``python -m safedpa_services.safety_filter``: turns wishes into actions that keep every robot of a fleet safe."""

from __future__ import annotations

import argparse
import dataclasses
import sys

from safedpa.bus.process import Stop, run_process
from safedpa.bus.setup import setup_message
from safedpa.dynamics import load_model
from safedpa.dynamics.model_setup import model_setup
from safedpa.safety.margin_text import margin_text
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.settings import write_settings
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
    setup = dataclasses.replace(
        model_setup(setup_message(SafetyFilterNode.name, vars(options)), model),
        settings=write_settings(settings),
        margin="" if margin is None else margin_text(margin),
    )
    return serve(SafetyFilterNode(model, settings, margin), options, stop, setup)


if __name__ == "__main__":
    parser = service_parser("safedpa-safety-filter")
    parser.add_argument("--settings", default="car", metavar="FILE.toml", help="settings: a file or a shipped name")
    parser.add_argument("--margin", default="", metavar="FILE.toml", help="from 'safedpa calibrate'")
    parser.add_argument("--off", action="store_true", help="hand wishes on unchecked; every verdict says so")
    run_process(work, parser)
