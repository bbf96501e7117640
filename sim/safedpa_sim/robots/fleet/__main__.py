"""``python -m safedpa_sim.robots.fleet``: many simulated cars in one process, for load tests of the services."""

from __future__ import annotations

import argparse
import os
import secrets
import sys
from pathlib import Path

from safedpa.bus.service.process import (
    RealtimePriority,
    StopSignal,
    add_bus_options,
    bus_from_options,
    freeze_garbage_collector,
    run_process,
)
from safedpa.errors import InputError
from safedpa_sim.robots.car.loads import LOADS
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.claim import claim_names
from safedpa_sim.robots.fleet.loop import FleetLoop
from safedpa_sim.robots.run_summary import check_writable, write_summary

_EPOCH_BITS = 53
_SWITCH_SECONDS = 0.0005
"""Thread switch interval: bounds how long the physics can delay the network thread, which time-stamps messages."""


def fleet_parser() -> argparse.ArgumentParser:
    """Returns the parser of the options of a fleet of simulated cars."""
    parser = argparse.ArgumentParser(prog="safedpa-robots", description="many simulated cars on the bus")
    add_bus_options(parser)
    parser.add_argument("--robots", type=int, default=10, help="number of cars")
    parser.add_argument(
        "--loads", default="none", metavar="LOAD,...", help=f"loads, assigned cyclically: none, {', '.join(LOADS)}"
    )
    parser.add_argument("--rate", type=float, default=20.0, help="ticks per second")
    parser.add_argument("--seconds", type=float, default=20.0, help="measured duration")
    parser.add_argument("--warm-seconds", type=float, default=3.0, help="warm-up before the measurement")
    parser.add_argument(
        "--in-step", action="store_true", help="publish all states at once; otherwise spread over the period"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the first car's scene; the following cars have the next seeds"
    )
    parser.add_argument("--begun", type=Path, required=True, help="file that is written when the measurement begins")
    parser.add_argument("--summary", type=Path, required=True, help="file for the summary of the run")
    return parser


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Runs until the time is over or ``stop``."""
    sys.setswitchinterval(_SWITCH_SECONDS)
    robots = _robots(options)
    check_writable(options.summary)
    check_writable(options.begun)
    with bus_from_options(options) as bus:
        with bus_from_options(_alongside(options)) as listener:
            claim_names(bus, list(robots), listener=listener)
        loop = FleetLoop(robots, bus, in_step=options.in_step)
        freeze_garbage_collector()
        loop.run(stop, options.warm_seconds)
        loop.begin_counting()
        before = os.times()
        write_summary({"pid": os.getpid()}, options.begun)
        loop.run(stop, options.seconds)
        after = os.times()
        write_summary({**loop.account(), "cpu_seconds": _spent(before, after)}, options.summary)
        stop.wait()  # the benchmark still reads the memory use of this process
    return 0


def _alongside(options: argparse.Namespace) -> argparse.Namespace:
    """Returns the bus options of a second session of this process that other processes need not discover."""
    return argparse.Namespace(**{**vars(options), "listen": [], "connect": options.listen or options.connect})


def _spent(before: os.times_result, after: os.times_result) -> float:
    return round(after.user + after.system - before.user - before.system, 3)


def _robots(options: argparse.Namespace) -> dict[str, CarRobot]:
    loads = options.loads.split(",")
    if not 1 <= options.robots <= 1000:
        raise InputError(f"--robots: got {options.robots}, wanted 1 to 1000")
    if not 1.0 <= options.rate <= 500.0:
        raise InputError(f"--rate: got {options.rate}, wanted 1 to 500 ticks per second")
    cars = {}
    for index in range(options.robots):
        scene = Scene.random(options.seed + index, loads[index % len(loads)])
        epoch = secrets.randbits(_EPOCH_BITS)
        cars[f"car{index:04d}"] = CarRobot(scene, 1.0 / options.rate, lockstep=False, epoch=epoch)
    return cars


if __name__ == "__main__":
    run_process(work, fleet_parser(), RealtimePriority.FILTER)
