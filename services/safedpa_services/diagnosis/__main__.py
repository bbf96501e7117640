"""``python -m safedpa_services.diagnosis``: finds out what the model of each robot lacks, and changes it on request."""

from __future__ import annotations

import argparse
import contextlib
import os
from pathlib import Path

from safedpa.bus import ASKED, NO_ROBOT, Answer, Bus, Request, ServiceLoop
from safedpa.bus.messages.requests import STATUS, asked_message
from safedpa.bus.messages.service_info import setup_message
from safedpa.bus.service.process import StopSignal, bus_from_options, log_lifetime, run_process
from safedpa.bus.service.service_log import ServiceLog
from safedpa.dynamics import LearnedBase, PhysicsModel, load_model, write_model
from safedpa.dynamics.model_offer import model_setup
from safedpa.errors import BusError
from safedpa.live.candidate_forecasts import forecast_with
from safedpa.live.change import ModelChanges
from safedpa.live.node import DiagnosisNode
from safedpa.live.versions import ModelVersion, VersionFolder
from safedpa.safety.defaults import margin_for
from safedpa.safety.margins.calibration import margin_text
from safedpa.systems.robots import DEFAULT_ROBOT
from safedpa_services.diagnosis.process_worker import ProcessWorker
from safedpa_services.service_main import service_parser

_NICENESS = 5
"""Also of its searches. The control loop has priority. Three busy processes on two cores leave a process of this
niceness a fifth of a core, and one of niceness 10 a fifteenth: a search that takes 4 s of processor time would need a
minute."""


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Serves until ``stop``; returns the exit code."""
    os.nice(_NICENESS)
    worker = ProcessWorker(options.settings)
    node = _node(options, worker)
    try:
        with bus_from_options(options) as bus:
            bus.answer_requests(node.answer, options.robot, lambda *asked: _report(bus, *asked))
            setup = model_setup(setup_message(node.name, vars(options)), load_model(options.model))
            bus.announce(NO_ROBOT, node.name, setup.instance)
            with log_lifetime(node.name, stop):
                ServiceLoop(node, bus, options.robot, setup=setup, service_log=ServiceLog(node.name)).run(stop)
    finally:
        worker.close()
    return 0


def _report(bus: Bus, robot: str, request: Request | None, answer: Answer) -> None:
    """Publishes a request and its answer for the recorder; status requests are left out."""
    if request is None or request.do != STATUS:
        with contextlib.suppress(BusError):  # the bus was closed meanwhile
            bus.publish(ASKED, robot or NO_ROBOT, asked_message(request, answer))


def _node(options: argparse.Namespace, worker: ProcessWorker) -> DiagnosisNode:
    model = load_model(options.model)
    margin = margin_for(model, options.margin)
    text = "" if margin is None else margin_text(margin)

    def changes(robot: str, first: ModelVersion) -> ModelChanges:
        return ModelChanges(first, VersionFolder(Path(options.versions) / robot) if options.versions else None)

    return DiagnosisNode(write_model(model), worker, text, changes, _folder(model), forecast_with(options.settings))


def _folder(model: PhysicsModel) -> Path | None:
    """Returns the folder of a learned model's weights; None for other models."""
    source = model.base.weights.source if isinstance(model.base, LearnedBase) else None
    return None if source is None else source.parent


def _parser() -> argparse.ArgumentParser:
    parser = service_parser("safedpa-diagnosis")
    settings_help = "settings of the filter: file or name"
    parser.add_argument("--settings", default=DEFAULT_ROBOT, metavar="FILE.toml", help=settings_help)
    parser.add_argument(
        "--margin", default="", metavar="FILE.toml", help="margin of the model, the same as the filter's"
    )
    parser.add_argument("--versions", default="", metavar="FOLDER", help="folder for the accepted models")
    return parser


if __name__ == "__main__":
    run_process(work, _parser())
