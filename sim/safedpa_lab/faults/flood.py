"""``python -m safedpa_lab.faults.flood``: robots that do not exist, and speak without end."""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

from safedpa.bus import STATE
from safedpa.bus.service.process import StopSignal, add_bus_options, bus_from_options, run_process
from safedpa_sim.robots import CarRobot, Scene


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Sends states until ``stop``; returns exit code 0."""
    messages = {
        f"flood{index}": CarRobot(Scene.random(index), lockstep=False, epoch=7).state_message()
        for index in range(options.robots)
    }
    pause = 1.0 / options.rate
    with bus_from_options(options) as bus:
        tick, due = 0, time.monotonic()
        while not stop():
            tick, due = tick + 1, due + pause
            for name, message in messages.items():
                bus.publish(STATE, name, replace(message, tick=tick, robot_time=tick * message.period))
            time.sleep(max(0.0, due - time.monotonic()))
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="safedpa-flood")
    add_bus_options(parser)
    parser.add_argument("--robots", type=int, default=8)
    parser.add_argument("--rate", type=float, default=100.0, help="states a second, of each")
    run_process(work, parser)
