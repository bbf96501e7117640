"""``python -m safedpa_sim.robots``: one simulated robot as a process of its own that speaks only the bus."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from pathlib import Path

from safedpa.bus.messages.service_info import setup_message
from safedpa.bus.service.process import (
    RealtimePriority,
    StopSignal,
    add_bus_options,
    bus_from_options,
    log_lifetime,
    run_process,
)
from safedpa.dynamics.own import load_own_of_environment
from safedpa.robot import DEFAULT_ROBOT, robot_named
from safedpa_sim.robots.account import account_of, check_writable, write_account
from safedpa_sim.robots.changes import CHANGES
from safedpa_sim.robots.claim import claim_name
from safedpa_sim.robots.loads import LOADS
from safedpa_sim.robots.loop import NoActionError, RobotLoop
from safedpa_sim.robots.pendulum_task import TASKS
from safedpa_sim.robots.stand_ins import robot_of
from safedpa_sim.robots.trace import TraceWriter


def robot_parser() -> argparse.ArgumentParser:
    """The options of a simulated robot."""
    parser = argparse.ArgumentParser(prog="safedpa-robot", description="a simulated robot on the bus")
    add_bus_options(parser)
    parser.add_argument("--robot", default=DEFAULT_ROBOT, help="kind of robot")
    parser.add_argument(
        "--world", action="append", default=[], metavar="NAME=NUMBER", help="of a stand-in of one's own"
    )
    parser.add_argument("--name", default="r1", help="name on the bus; one robot each")
    parser.add_argument(
        "--drive", choices=("speed_servo", "throttle"), default="speed_servo", help="what commands the car's motor"
    )
    parser.add_argument("--load", choices=("none", *LOADS), default="none", help="what it tows")
    parser.add_argument("--change", choices=("none", *CHANGES), default="none", help="what changes while it drives")
    parser.add_argument("--change-after", type=float, default=30.0, metavar="SECONDS", help="when, by its clock")
    parser.add_argument("--laser", action="store_true", help="the car is told no obstacles, and has a laser scanner")
    parser.add_argument("--people", type=int, default=0, help="who walk about where the car drives; needs --laser")
    parser.add_argument("--task", choices=tuple(TASKS), default="balance", help="what the pendulum has to do")
    parser.add_argument("--wind", type=float, default=0.0, metavar="SPEED", help="m/s, on the pendulum")
    parser.add_argument(
        "--wind-direction", type=float, default=0.0, metavar="DEGREES", help="where it blows to: 0 aside, 90 up"
    )
    parser.add_argument("--force", type=float, default=0.0, metavar="NEWTON", help="of the wind, on the point robot")
    parser.add_argument("--payload", type=float, default=0.0, metavar="KG", help="hung on the pendulum's mass")
    parser.add_argument(
        "--dry-friction", type=float, default=0.0, metavar="TORQUE", help="N m in the pendulum's hinge, at any rate"
    )
    parser.add_argument("--seed", type=int, default=0, help="scene: obstacles, start, goals")
    parser.add_argument(
        "--seconds", type=float, default=0.0, help="drive for so long by the robot's clock; 0: for ever"
    )
    parser.add_argument("--lockstep", action="store_true", help="wait for each action: a run repeats bit for bit")
    parser.add_argument("--rate", type=float, help="ticks per second; default: the robot's own")
    parser.add_argument("--summary", type=Path, default=None, help="write the account of the run here")
    parser.add_argument("--await-word", action="store_true", help="drive when the supervisor says so")
    parser.add_argument("--trace", type=Path, default=None, help="append what was done in every period here")
    return parser


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Drives until the time is over or ``stop``; 0, or 1 when in lockstep no one answered."""
    load_own_of_environment()
    options.rate = robot_named(options.robot).rate if options.rate is None else options.rate
    robot = robot_of(options)
    if options.summary is not None:
        check_writable(options.summary)
    with bus_from_options(options) as bus, contextlib.ExitStack() as files:
        claim_name(bus, options.name)
        if options.await_word:
            stop.await_word()
            if stop():
                return 0
        files.enter_context(log_lifetime("robot", stop))
        trace = None if options.trace is None else files.enter_context(TraceWriter(options.trace))
        setup = setup_message("robot", vars(options))
        loop = RobotLoop(robot, bus, options.name, trace=trace, setup=setup)
        code = 0
        try:
            loop.run(stop, round(options.seconds * options.rate))
        except NoActionError as error:
            sys.stderr.write(f"safedpa-robot: {error}\n")
            code = 1
        end = stop.reason or ("time is over" if code == 0 else "no action")
        if stop():
            loop.brake(publish=True)
        account = account_of(robot, loop.latencies, loop.overruns, end)
        if not stop():
            loop.brake(publish=False)  # after the account: a run of N seconds has N seconds' ticks
        if options.summary is not None:
            write_account(account, options.summary)
        sys.stdout.write(json.dumps(account) + "\n")
    return code


if __name__ == "__main__":
    run_process(work, robot_parser(), RealtimePriority.ROBOT)
