"""``python -m safedpa_services.ros_gateway``: a robot that speaks ROS 2, as a robot of the bus."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from safedpa.bus import Bus
from safedpa.bus.loop.process import Stop, Urgency, add_bus_options, bus_from, lifetime, run_process
from safedpa.bus.security.access import role_of_robot
from safedpa.dynamics.own import load_own_of_environment
from safedpa_services.ros_gateway.making import made
from safedpa_services.ros_gateway.robot_file import load_robot_file

__all__ = ["parser", "work"]

_POLICY = "policy"
"""Whose certificate is shown for the wish; it lies beside the robot's."""


def parser() -> argparse.ArgumentParser:
    """Options of the process."""
    found = argparse.ArgumentParser(prog="safedpa-ros-gateway")
    add_bus_options(found)
    found.add_argument("file", type=Path, metavar="ROBOT.toml", help="see docs/ros.md")
    found.add_argument(
        "--policy-card", type=int, metavar="DESCRIPTOR", help="read the policy's certificate and key there"
    )
    return found


def work(options: argparse.Namespace, stop: Stop) -> int:
    """Drives until ``stop``; returns exit code 0."""
    load_own_of_environment()
    asked = load_robot_file(options.file)
    if options.certificates is not None and not options.role:
        options.role = role_of_robot(asked.name)
    with (
        bus_from(options) as bus,
        _wishing(options, bus, wishes=bool(asked.wish.topic)) as wishing,
        made(asked, bus, wishing) as gateway,
        lifetime("robot", stop),
    ):
        gateway.run(stop)
    return 0


@contextmanager
def _wishing(options: argparse.Namespace, bus: Bus, *, wishes: bool) -> Iterator[Bus]:
    """The bus over which the robot's own policy wishes: with certificates a robot's may not, the policy's may."""
    card, options.policy_card = options.policy_card, None
    if not wishes or (options.certificates is None and card is None):
        yield bus
        return
    with bus_from(argparse.Namespace(**{**vars(options), "role": _POLICY, "card": card, "listen": []})) as other:
        yield other


if __name__ == "__main__":
    run_process(work, parser(), Urgency.ROBOT)
