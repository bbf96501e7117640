"""``python -m safedpa_services.metrics --port 9464``: serves a fleet's metrics to Prometheus."""

from __future__ import annotations

import argparse
import os
import uuid

from safedpa.bus import NO_ROBOT
from safedpa.bus.monitor import FleetOverview
from safedpa.bus.service.process import StopSignal, add_bus_options, bus_from_options, log_lifetime, run_process
from safedpa.extras import need
from safedpa_services.metrics.exporter import Exporter

_SERVICE = "metrics"


def metrics_parser() -> argparse.ArgumentParser:
    """Returns a parser with the options of the exporter."""
    parser = argparse.ArgumentParser(prog="safedpa-metrics", description="serve a fleet's metrics to Prometheus")
    add_bus_options(parser)
    parser.add_argument("--robot", default="*", help="only this robot")
    parser.add_argument("--port", type=int, default=9464, help="TCP port of the page /metrics; 0: any free one")
    parser.add_argument("--bind", default="127.0.0.1", help="address to listen at; 0.0.0.0 lets other machines scrape")
    return parser


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Serves until ``stop``; returns the exit code."""
    need("metrics", what="the page of metrics")
    os.nice(10)  # the control loop has priority
    with bus_from_options(options) as bus, log_lifetime(_SERVICE, stop):
        bus.announce(NO_ROBOT, _SERVICE, uuid.uuid4().hex[:12])
        Exporter(FleetOverview(bus, options.robot), options.bind, options.port).run(stop)
    return 0


if __name__ == "__main__":
    run_process(work, metrics_parser())
