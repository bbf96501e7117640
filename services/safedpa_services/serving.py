"""What every service's ``__main__`` shares: options, name on the bus, the loop."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial

from safedpa.bus import MODEL, NO_ROBOT, AbstractNode, AbstractTransport, Bus, ModelMessage, ServiceLoop, ZenohTransport
from safedpa.bus.loop.apart import AbstractTicket, Apart
from safedpa.bus.loop.collector import settle_collector
from safedpa.bus.loop.journal import Journal
from safedpa.bus.loop.process import Stop, add_bus_options, lifetime, settings_from
from safedpa.bus.loop.turning import Turning
from safedpa.bus.transport.in_process import JointTransport
from safedpa.robot import DEFAULT_ROBOT
from safedpa_services.nodes import Made

__all__ = ["serve", "service_parser"]

_SWITCH_SECONDS = 0.0005
"""After so long a step gives way to the network's thread, which stamps what arrives; Python's own 5 ms are long."""


def service_parser(program: str) -> argparse.ArgumentParser:
    """Options that every service takes: the bus, the model, the robot."""
    parser = argparse.ArgumentParser(prog=program)
    add_bus_options(parser)
    parser.add_argument("--model", default=DEFAULT_ROBOT, help="model file, or the name of one that ships")
    parser.add_argument("--robot", default="*", help="serve this robot alone")
    return parser


def serve(
    services: Sequence[Made],
    options: argparse.Namespace,
    stop: Stop,
    serves: Callable[[str], bool] | None = None,
) -> int:
    """Runs one service on the bus, or several in the direction of their data, until ``stop``; returns exit code 0.

    Each tells its setup. ``serves(robot)`` says of which robots they take anything; None: of all.
    """
    sys.setswitchinterval(_SWITCH_SECONDS)
    _try_offers_apart(services, options)
    transport: AbstractTransport = ZenohTransport(settings_from(options))
    if len(services) > 1:
        inside = frozenset(topic.name for made in services for topic in made.node.outputs) & frozenset(
            topic.name for made in services for topic in made.node.inputs
        )
        transport = JointTransport(transport, inside)
    with Bus(transport, options.fleet) as bus, ExitStack() as lifetimes:
        for made in services:
            made.joined(bus)
        settle_collector()
        for made in services:
            bus.announce(NO_ROBOT, made.node.name, made.setup.instance)
            lifetimes.enter_context(lifetime(made.node.name, stop))
        Turning([_loop(made, Bus(transport, options.fleet, serves=serves), options) for made in services]).run(stop)
    return 0


def _try_offers_apart(services: Sequence[Made], options: argparse.Namespace) -> None:
    """What is offered over the bus is tried in one process beside this one before anybody here looks into it.

    Started before there is any link, and any thread of the network's.
    """
    nodes = [made.node for made in services if MODEL in made.node.listens]
    if nodes:
        apart = Apart("safedpa_services.trying:tried")
        for node in nodes:
            node.try_apart(partial(_hand_in, apart, node, options))


def _hand_in(
    apart: Apart, node: AbstractNode, options: argparse.Namespace, robot: str, offer: ModelMessage
) -> AbstractTicket:
    return apart.hand_in((node.name, options, robot, offer, node.newest(robot), node.agreed(robot)))


def _loop(made: Made, bus: Bus, options: argparse.Namespace) -> ServiceLoop:
    """Each has a bus of its own, since each holds back its own outputs until its robots are through."""
    return ServiceLoop(made.node, bus, options.robot, setup=made.setup, journal=Journal(made.node.name))
