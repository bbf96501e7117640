"""Builds the services of the control loop from their command-line options: node, setup message and request handlers.

A service's process builds one of them; the stack builds adaptation, policy and safety filter. Each function imports
only what its service needs, because the robot waits for the slowest process to start.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from safedpa.bus import AbstractNode, Answer, Bus, Request, SetupMessage
from safedpa.bus.logging import log_event
from safedpa.bus.messages.requests import CONFIRM, ORDER, SENSE
from safedpa.bus.messages.service_info import setup_message
from safedpa.systems.robots import DEFAULT_ROBOT

if TYPE_CHECKING:
    from safedpa.perception.overrides import SensorOverrides
    from safedpa.runtime.stop_orders import StopOrders


def _nothing(_bus: Bus) -> None:
    return


@dataclass(frozen=True)
class PreparedService:
    """A service that is ready to join the bus."""

    node: AbstractNode
    setup: SetupMessage
    joined: Callable[[Bus], None] = _nothing
    """Called once with the bus, before the first tick; registers request handlers."""


def adaptation(options: argparse.Namespace) -> PreparedService:
    """Builds the adaptation. Raises InputError if the model cannot be loaded or does not fit."""
    from safedpa.adaptation import AdaptationNode
    from safedpa.dynamics import load_model
    from safedpa.dynamics.model_offer import model_setup

    model = load_model(options.model)
    node = AdaptationNode(model)
    return PreparedService(node, model_setup(setup_message(node.name, vars(options)), model))


def add_perception_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options of perception."""
    parser.add_argument("--perception", default="", metavar="FILE.toml", help="its settings, sources and zones")
    parser.add_argument(
        "--orders", default="", metavar="FILE", help="keeps switched sources and zones across a restart"
    )


def perception(options: argparse.Namespace) -> PreparedService:
    """Builds perception, which needs no model: it uses scans and odometry only.

    Raises InputError if its settings file is invalid.
    """
    from safedpa.perception import PerceptionNode, PerceptionSettings, load_perception

    settings, text = load_perception(Path(options.perception)) if options.perception else (PerceptionSettings(), "")
    node = PerceptionNode(settings, Path(options.orders) if options.orders else None)
    setup = dataclasses.replace(setup_message(node.name, vars(options)), settings=text)
    return PreparedService(node, setup, lambda bus: _take_switches(bus, options.robot, node.switches))


def _take_switches(bus: Bus, robot: str, switches: SensorOverrides) -> None:
    bus.answer_requests(switches.answer, robot, partial(_log_order, "perception"), (SENSE,))
    if switches.lost:
        log_event(
            "order.lost", f"{switches.lost}: no source is used until 'safedpa sense' switches it on", level="error"
        )
    for name, orders in switches.retained.items():
        log_event(
            "order.restored",
            f"switched by orders kept from before the restart: {orders}",
            level="warning",
            robot=name,
        )


def add_policy_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options of the policy."""
    parser.add_argument(
        "--controller", default="", help="name of a controller of the robot; default: the one that fits the model"
    )


def policy(options: argparse.Namespace) -> PreparedService:
    """Builds the policy. Raises InputError if the model or the controller cannot be loaded or does not fit."""
    from safedpa.dynamics import load_model
    from safedpa.dynamics.model_offer import model_setup
    from safedpa.policy import PolicyNode

    model = load_model(options.model)
    node = PolicyNode(model, controller=options.controller or None)
    setup = model_setup(setup_message(node.name, vars(options)), model)
    return PreparedService(node, dataclasses.replace(setup, controller=options.controller))


def add_filter_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options of the safety filter."""
    parser.add_argument(
        "--settings", default=DEFAULT_ROBOT, metavar="FILE.toml", help="settings: a file or the name of a robot"
    )
    parser.add_argument("--margin", default="", metavar="FILE.toml", help="from 'safedpa calibrate'")
    parser.add_argument("--orders", default="", metavar="FILE", help="keeps stop orders across a restart")
    parser.add_argument(
        "--standby",
        action="store_true",
        help="serve only with the router's lease, and wait for it while another filter holds it",
    )
    parser.add_argument(
        "--off", action="store_true", help="pass nominal actions on unchecked; every verdict reports 'disabled'"
    )


def safety_filter(options: argparse.Namespace) -> PreparedService:
    """Builds the safety filter. Raises InputError if model, settings or margin cannot be loaded or do not fit."""
    from safedpa.dynamics import load_model
    from safedpa.dynamics.model_offer import model_setup
    from safedpa.runtime.node import SafetyFilterNode
    from safedpa.runtime.stop_orders import StopOrders
    from safedpa.safety.defaults import margin_for, settings_named
    from safedpa.safety.margins.calibration import margin_text
    from safedpa.safety.settings import write_settings

    settings = settings_named(options.settings)
    settings = dataclasses.replace(settings, enabled=settings.enabled and not options.off)
    model = load_model(options.model)
    margin = margin_for(model, options.margin)
    if margin is None:
        sys.stderr.write(
            "margin: none was calibrated for this model; the filter uses epsilon of its settings instead\n"
        )
    setup = dataclasses.replace(
        model_setup(setup_message(SafetyFilterNode.name, vars(options)), model),
        settings=write_settings(settings),
        margin="" if margin is None else margin_text(margin),
    )
    orders = StopOrders(Path(options.orders) if options.orders else None)
    return PreparedService(
        SafetyFilterNode(model, settings, margin, orders), setup, lambda bus: _take_orders(bus, orders)
    )


def _take_orders(bus: Bus, orders: StopOrders) -> None:
    """Answers stop orders about every robot, including robots that have not joined yet."""
    bus.answer_requests(orders.answer, report_progress=partial(_log_order, "safety_filter"), kinds=(ORDER, CONFIRM))
    for robot, reason in orders.active.items():
        log_event(
            "order.restored",
            f"stopped by an order kept from before the restart: {reason}",
            level="warning",
            robot=robot,
        )


def _log_order(service: str, robot: str, request: Request | None, answer: Answer) -> None:
    if request is None or request.do != "status":
        kind = "order.taken" if answer.ok else "order.refused"
        who = request.who if request is not None else ""
        level = "info" if answer.ok else "warning"  # the verdicts report its effect
        log_event(kind, answer.sentence, level=level, robot=robot, service=service, who=who)
