"""``python -m safedpa_services.adaptation``: estimates what the model leaves free, for every robot of a fleet."""

from __future__ import annotations

import argparse

from safedpa.adaptation import AdaptationNode
from safedpa.bus.process import Stop, run_process
from safedpa.bus.setup import setup_message
from safedpa.dynamics import load_model
from safedpa.dynamics.model_setup import model_setup
from safedpa_services.serving import serve, service_parser


def work(options: argparse.Namespace, stop: Stop) -> int:
    """Serves until ``stop``; returns the exit code."""
    model = load_model(options.model)
    node = AdaptationNode(model)
    return serve(node, options, stop, model_setup(setup_message(node.name, vars(options)), model))


if __name__ == "__main__":
    run_process(work, service_parser("safedpa-adaptation"))
