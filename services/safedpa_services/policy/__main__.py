"""``python -m safedpa_services.policy``: wishes for actions that lead every robot of a fleet to its goal."""

from __future__ import annotations

import argparse
import dataclasses

from safedpa.bus.process import Stop, run_process
from safedpa.bus.setup import setup_message
from safedpa.dynamics import load_model
from safedpa.dynamics.model_setup import model_setup
from safedpa.policy import PolicyNode
from safedpa.policy.controller import CONTROLLERS
from safedpa_services.serving import serve, service_parser


def work(options: argparse.Namespace, stop: Stop) -> int:
    """Serves until ``stop``; returns the exit code."""
    model = load_model(options.model)
    node = PolicyNode(model, controller=options.controller or None)
    setup = model_setup(setup_message(node.name, vars(options)), model)
    return serve(node, options, stop, dataclasses.replace(setup, controller=options.controller))


if __name__ == "__main__":
    parser = service_parser("safedpa-policy")
    parser.add_argument("--controller", default="", choices=("", *CONTROLLERS), help="default: as the model allows")
    run_process(work, parser)
