"""What the ``__main__`` modules of all services share: command-line options and the service loop."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial

from safedpa.bus import MODEL, NO_ROBOT, AbstractNode, AbstractTransport, Bus, ModelMessage, ServiceLoop, ZenohTransport
from safedpa.bus.logging import log_event
from safedpa.bus.service.lease import ASK_SECONDS, Lease, LeasedTransport, LeaseKeeper, wait_for_lease
from safedpa.bus.service.process import (
    StopSignal,
    add_bus_options,
    freeze_garbage_collector,
    log_lifetime,
    transport_settings_from_options,
)
from safedpa.bus.service.sandbox import JobHandle, JobProcess
from safedpa.bus.service.service_log import ServiceLog
from safedpa.bus.service.service_loop import SHUTDOWN_SECONDS, Scheduler
from safedpa.bus.transport.memory import JointTransport
from safedpa.errors import InputError
from safedpa.extras import need_linux
from safedpa.systems.robots import DEFAULT_ROBOT
from safedpa_services.service_factories import PreparedService

_SWITCH_SECONDS = 0.0005
"""Thread switch interval. With Python's default of 5 ms, a step would delay the network thread, which stamps
arrivals."""


def service_parser(program: str) -> argparse.ArgumentParser:
    """Returns a parser with the options of every service: the bus, the model, the robot. Ends where none can run."""
    try:
        need_linux(program)
    except InputError as error:
        sys.exit(str(error))
    parser = argparse.ArgumentParser(prog=program)
    add_bus_options(parser)
    parser.add_argument("--model", default=DEFAULT_ROBOT, help="model file, or the name of one that ships")
    parser.add_argument("--robot", default="*", help="serve only this robot")
    return parser


def serve(
    services: Sequence[PreparedService],
    options: argparse.Namespace,
    stop: StopSignal,
    serves: Callable[[str], bool] | None = None,
) -> int:
    """Runs services on the bus until ``stop``; returns exit code 0.

    Several services are given in the order of their data flow. Messages of robots for which ``serves(robot)`` is false
    are ignored; None: all robots are served.
    """
    sys.setswitchinterval(_SWITCH_SECONDS)
    _run_model_trials_in_a_process(services, options)
    transport: AbstractTransport = ZenohTransport(transport_settings_from_options(options))
    if len(services) > 1:
        inside = frozenset(topic.name for service in services for topic in service.node.outputs) & frozenset(
            topic.name for service in services for topic in service.node.inputs
        )
        transport = JointTransport(transport, inside)
    leased = LeasedTransport(transport) if getattr(options, "standby", False) else None
    transport = leased or transport
    stopped: Callable[[], bool] = stop
    with Bus(transport, options.fleet) as bus, ExitStack() as lifetimes:
        if leased is not None:
            keeper = _lease_of(services[0], leased, bus, stop)
            if keeper is None:  # it was to end while it waited
                return 0
            lifetimes.callback(keeper.end)
            stopped = partial(_reported, keeper, stop)
        for service in services:
            service.joined(bus)
        freeze_garbage_collector()
        for service in services:
            bus.announce(NO_ROBOT, service.node.name, service.setup.instance)
            lifetimes.enter_context(log_lifetime(service.node.name, stop))
        Scheduler([_loop(service, Bus(transport, options.fleet, serves=serves), options) for service in services]).run(
            stopped
        )
    return 0


def _lease_of(service: PreparedService, leased: LeasedTransport, bus: Bus, stop: StopSignal) -> LeaseKeeper | None:
    """Waits for the lease of the safety filter, and returns what keeps it; None if the process is to end."""
    from safedpa.runtime.node import SafetyFilterNode

    node = service.node
    assert isinstance(node, SafetyFilterNode)  # no other service has the option
    lease = Lease(partial(bus.ask_lease, timeout=ASK_SECONDS), service.setup.instance)
    log_event("lease.waiting", "waits for the lease of the safety filter", service=node.name)
    carried = wait_for_lease(lease, stop)
    if carried is None:
        return None
    node.orders.inherit(carried)
    leased.lease = lease
    keeper = LeaseKeeper(lease, node.orders.text)
    node.orders.on_change = keeper.renew_soon
    log_event("lease.taken", f"holds the lease, as the {lease.term}. since the router's start", service=node.name)
    return keeper


def _reported(keeper: LeaseKeeper, stop: StopSignal) -> bool:
    """Reports progress of the loop to the keeper; returns whether the loop should end."""
    keeper.progress(SHUTDOWN_SECONDS if stop() else 0.0)  # while it ends, the loop asks no more
    return stop()


def _run_model_trials_in_a_process(services: Sequence[PreparedService], options: argparse.Namespace) -> None:
    """Starts the process in which models offered over the bus are tried before this process reads them.

    Called before the bus is opened: the process must not inherit its links and threads.
    """
    nodes = [service.node for service in services if MODEL in service.node.listens]
    if nodes:
        trials = JobProcess("safedpa_services.model_trial:run_model_trial")
        for node in nodes:
            node.use_sandbox(partial(_submit_trial, trials, node, options))


def _submit_trial(
    trials: JobProcess, node: AbstractNode, options: argparse.Namespace, robot: str, offer: ModelMessage
) -> JobHandle:
    return trials.submit((node.name, options, robot, offer, node.newest(robot), node.agreed(robot)))


def _loop(service: PreparedService, bus: Bus, options: argparse.Namespace) -> ServiceLoop:
    """Each loop has a ``Bus`` of its own, because each batches its outputs separately."""
    return ServiceLoop(service.node, bus, options.robot, setup=service.setup, service_log=ServiceLog(service.node.name))
