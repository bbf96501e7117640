"""``python -m safedpa_services.safety_filter``: turns wishes into actions that keep every robot of a fleet safe."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

from safedpa.bus import Answer, Bus, Request
from safedpa.bus.log import log_event
from safedpa.bus.process import Stop, run_process
from safedpa.bus.requests import ORDER
from safedpa.bus.setup import setup_message
from safedpa.dynamics import load_model
from safedpa.dynamics.model_setup import model_setup
from safedpa.safety.margin_text import margin_text
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.orders import Orders
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
    orders = Orders(Path(options.orders) if options.orders else None)
    node = SafetyFilterNode(model, settings, margin, orders)
    return serve(node, options, stop, setup, lambda bus: _take_orders(bus, orders))


def _take_orders(bus: Bus, orders: Orders) -> None:
    """An order about any robot is kept, be it heard of or not: one that was not there yet may come."""
    bus.answer_requests(orders.answer, tell=_log_order, kinds=(ORDER,))
    for robot, reason in orders.kept.items():
        log_event("order.kept", f"stopped by an order that was kept: {reason}", level="warning", robot=robot)


def _log_order(robot: str, request: Request | None, answer: Answer) -> None:
    if request is None or request.do != "status":
        kind = "order.taken" if answer.ok else "order.refused"
        who = request.who if request is not None else ""
        level = "info" if answer.ok else "warning"  # what comes of an order is told by the verdicts
        log_event(kind, answer.sentence, level=level, robot=robot, service="safety_filter", who=who)


if __name__ == "__main__":
    parser = service_parser("safedpa-safety-filter")
    parser.add_argument("--settings", default="car", metavar="FILE.toml", help="settings: a file or a shipped name")
    parser.add_argument("--margin", default="", metavar="FILE.toml", help="from 'safedpa calibrate'")
    parser.add_argument("--orders", default="", metavar="FILE", help="keeps orders to stop over a restart")
    parser.add_argument("--off", action="store_true", help="hand wishes on unchecked; every verdict says so")
    run_process(work, parser)
