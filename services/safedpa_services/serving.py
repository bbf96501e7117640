"""What every service's ``__main__`` shares: options, name on the bus, the loop."""

from __future__ import annotations

import argparse
import gc
from collections.abc import Callable

from safedpa.bus import NO_ROBOT, AbstractNode, Bus, ServiceLoop, SetupMessage
from safedpa.bus.journal import Journal
from safedpa.bus.process import Stop, add_bus_options, bus_from, lifetime

__all__ = ["serve", "service_parser"]


def service_parser(program: str) -> argparse.ArgumentParser:
    """Options that every service takes: the bus, the model, the robot."""
    parser = argparse.ArgumentParser(prog=program)
    add_bus_options(parser)
    parser.add_argument("--model", default="car", help="model file, or the name of one that ships")
    parser.add_argument("--robot", default="*", help="serve this robot alone")
    return parser


def serve(
    node: AbstractNode,
    options: argparse.Namespace,
    stop: Stop,
    setup: SetupMessage,
    joined: Callable[[Bus], None] = lambda _bus: None,
) -> int:
    """Runs the node on the bus until ``stop``, and tells its setup; returns exit code 0.

    ``joined`` is called once, before the first tick, for what else the service does on the bus.
    """
    with bus_from(options) as bus:
        joined(bus)
        gc.collect()
        gc.freeze()  # what lives now lives for ever; the collector need not look at it in the middle of a tick
        bus.announce(NO_ROBOT, node.name, setup.instance)
        with lifetime(node.name, stop):
            ServiceLoop(node, bus, options.robot, setup=setup, journal=Journal(node.name)).run(stop)
    return 0
