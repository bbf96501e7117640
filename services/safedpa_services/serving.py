"""What every service's ``__main__`` shares: options, name on the bus, the loop."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial

from safedpa.bus import MODEL, NO_ROBOT, AbstractNode, AbstractTransport, Bus, ModelMessage, ServiceLoop, ZenohTransport
from safedpa.bus.service.process import (
    StopSignal,
    add_bus_options,
    freeze_garbage_collector,
    log_lifetime,
    transport_settings_from_options,
)
from safedpa.bus.service.sandbox import AbstractJobHandle, JobProcess
from safedpa.bus.service.scheduler import Scheduler
from safedpa.bus.service.service_log import ServiceLog
from safedpa.bus.transport.memory import JointTransport
from safedpa.robot import DEFAULT_ROBOT
from safedpa_services.nodes import PreparedService

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
    services: Sequence[PreparedService],
    options: argparse.Namespace,
    stop: StopSignal,
    serves: Callable[[str], bool] | None = None,
) -> int:
    """Runs one service on the bus, or several in the direction of their data, until ``stop``; returns exit code 0.

    Each tells its setup. ``serves(robot)`` says of which robots they take anything; None: of all.
    """
    sys.setswitchinterval(_SWITCH_SECONDS)
    _try_offers_apart(services, options)
    transport: AbstractTransport = ZenohTransport(transport_settings_from_options(options))
    if len(services) > 1:
        inside = frozenset(topic.name for made in services for topic in made.node.outputs) & frozenset(
            topic.name for made in services for topic in made.node.inputs
        )
        transport = JointTransport(transport, inside)
    with Bus(transport, options.fleet) as bus, ExitStack() as lifetimes:
        for made in services:
            made.joined(bus)
        freeze_garbage_collector()
        for made in services:
            bus.announce(NO_ROBOT, made.node.name, made.setup.instance)
            lifetimes.enter_context(log_lifetime(made.node.name, stop))
        Scheduler([_loop(made, Bus(transport, options.fleet, serves=serves), options) for made in services]).run(stop)
    return 0


def _try_offers_apart(services: Sequence[PreparedService], options: argparse.Namespace) -> None:
    """What is offered over the bus is tried in one process next to this one before anybody here looks into it.

    Started before there is any link, and any thread of the network's.
    """
    nodes = [made.node for made in services if MODEL in made.node.listens]
    if nodes:
        apart = JobProcess("safedpa_services.trying:tried")
        for node in nodes:
            node.try_apart(partial(_hand_in, apart, node, options))


def _hand_in(
    apart: JobProcess, node: AbstractNode, options: argparse.Namespace, robot: str, offer: ModelMessage
) -> AbstractJobHandle:
    return apart.hand_in((node.name, options, robot, offer, node.newest(robot), node.agreed(robot)))


def _loop(made: PreparedService, bus: Bus, options: argparse.Namespace) -> ServiceLoop:
    """Each has a bus of its own, since each holds back its own outputs until its robots are through."""
    return ServiceLoop(made.node, bus, options.robot, setup=made.setup, service_log=ServiceLog(made.node.name))
