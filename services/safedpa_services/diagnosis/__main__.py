"""``python -m safedpa_services.diagnosis``: tells of every robot of a fleet what its model lacks."""

from __future__ import annotations

import argparse
import os

from safedpa.bus.process import Stop, run_process
from safedpa.diagnosis.live.node import DiagnosisNode
from safedpa.dynamics import load_model, write_model
from safedpa_services.diagnosis.process_worker import ProcessWorker
from safedpa_services.serving import serve, service_parser


def work(options: argparse.Namespace, stop: Stop) -> int:
    """Serves until ``stop``; returns the exit code."""
    os.nice(10)  # nobody waits for it
    worker = ProcessWorker(options.settings)
    try:
        return serve(DiagnosisNode(write_model(load_model(options.model)), worker), options, stop)
    finally:
        worker.close()


if __name__ == "__main__":
    parser = service_parser("safedpa-diagnosis")
    parser.add_argument("--settings", default="car", metavar="FILE.toml", help="settings of the filter: file or name")
    run_process(work, parser)
