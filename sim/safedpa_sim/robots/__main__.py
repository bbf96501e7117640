"""``python -m safedpa_sim.robots``: one simulated robot as a process on the bus."""

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
from safedpa.dynamics.user_files import load_user_files
from safedpa.errors import RecordingError
from safedpa.systems.robots import DEFAULT_ROBOT, robot_named
from safedpa_sim.robots.car.loads import LOADS
from safedpa_sim.robots.car.robot import CHANGES, CarRobot
from safedpa_sim.robots.claim import claim_name
from safedpa_sim.robots.loop import NoActionError, RobotLoop
from safedpa_sim.robots.pendulum.robot import TASKS
from safedpa_sim.robots.robot_factory import make_robot
from safedpa_sim.robots.run_summary import TraceWriter, check_writable, summarise_run, write_summary


def robot_parser() -> argparse.ArgumentParser:
    """Returns the parser of the options of a simulated robot."""
    parser = argparse.ArgumentParser(prog="safedpa-robot", description="a simulated robot on the bus")
    add_bus_options(parser)
    parser.add_argument("--robot", default=DEFAULT_ROBOT, help="kind of robot")
    parser.add_argument(
        "--world",
        action="append",
        default=[],
        metavar="NAME=NUMBER",
        help="parameter of the stand-in of a robot package",
    )
    parser.add_argument("--name", default="r1", help="unique name on the bus")
    parser.add_argument(
        "--drive",
        choices=("speed_servo", "throttle"),
        default="speed_servo",
        help="command interface of the car's motor",
    )
    parser.add_argument("--load", choices=("none", *LOADS), default="none", help="towed load")
    parser.add_argument("--change", choices=("none", *CHANGES), default="none", help="change during the drive")
    parser.add_argument(
        "--change-after", type=float, default=30.0, metavar="SECONDS", help="earliest robot time of the change"
    )
    parser.add_argument("--laser", action="store_true", help="a car with a laser scanner and without known obstacles")
    parser.add_argument("--people", type=int, default=0, help="number of people walking on the field; needs --laser")
    parser.add_argument("--task", choices=tuple(TASKS), default="balance", help="task of the pendulum")
    parser.add_argument("--wind", type=float, default=0.0, metavar="SPEED", help="wind speed on the pendulum in m/s")
    parser.add_argument(
        "--wind-direction",
        type=float,
        default=0.0,
        metavar="DEGREES",
        help="direction that the wind blows towards: 0 sideways, 90 up",
    )
    parser.add_argument("--force", type=float, default=0.0, metavar="NEWTON", help="wind force on the point robot")
    parser.add_argument("--payload", type=float, default=0.0, metavar="KG", help="additional mass of the pendulum")
    parser.add_argument(
        "--dry-friction", type=float, default=0.0, metavar="TORQUE", help="dry friction of the pendulum's hinge in N m"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of obstacles, start and goals")
    parser.add_argument("--seconds", type=float, default=0.0, help="duration in robot time; 0: no limit")
    parser.add_argument(
        "--lockstep", action="store_true", help="wait for each action, which makes a run reproducible bit for bit"
    )
    parser.add_argument("--rate", type=float, help="ticks per second; default: the robot's own")
    parser.add_argument("--summary", type=Path, default=None, help="file for the summary of the run")
    parser.add_argument("--await-word", action="store_true", help="wait for the supervisor's start signal")
    parser.add_argument(
        "--change-on-word", action="store_true", help="hold the change back until the supervisor's second signal"
    )
    parser.add_argument("--trace", type=Path, default=None, help="file for a trace of every period")
    return parser


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Runs until the time is over or ``stop``; returns 0, or 1 if no action arrived in lockstep."""
    load_user_files()
    options.rate = robot_named(options.robot).rate if options.rate is None else options.rate
    robot = make_robot(options)
    if options.change_on_word and isinstance(robot, CarRobot):
        robot.hold_change(lambda: stop.signals > 1)
    if options.summary is not None:
        check_writable(options.summary)
    with bus_from_options(options) as bus, contextlib.ExitStack() as files:
        claim_name(bus, options.name)
        if options.await_word:
            stop.wait_for_start()
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
        summary = summarise_run(robot, loop.latencies, loop.overruns, end)
        if not stop():
            loop.brake(publish=False)  # after the summary: a run of N seconds reports the ticks of N seconds
        if options.summary is not None:
            try:
                write_summary(summary, options.summary)
            except RecordingError as error:  # the drive is over: a full disk must not let it begin again
                sys.stderr.write(f"safedpa-robot: {error}\n")
                code = 1
        sys.stdout.write(json.dumps(summary) + "\n")
    return code


if __name__ == "__main__":
    run_process(work, robot_parser(), RealtimePriority.ROBOT)
