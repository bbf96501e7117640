"""Failures of the loop of a ROS 2 car: does it brake, how soon, and which node reports it."""

from __future__ import annotations

import signal
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from safedpa.errors import InputError, SafedpaError, did_you_mean
from safedpa_lab.ros.side import Loop, Node, Side, robot_file, services, side

__all__ = ["FAULTS", "run_fault"]

_BEFORE, _AFTER, _LONGEST = 2.5, 4.0, 60.0
_STARTS = 15.0

Act = Callable[[Side, Loop, Node], None]


def _killed(name: str) -> Act:
    def act(robot: Side, loop: Loop, car: Node) -> None:
        del robot, car
        loop.children[name].send_signal(signal.SIGKILL)

    return act


def _message(word: str) -> Act:
    def act(robot: Side, loop: Loop, car: Node) -> None:
        del robot, loop
        car.send(word)

    return act


def _router(robot: Side, loop: Loop, car: Node) -> None:
    del loop, car
    robot.router.kill()


def _policy(robot: Side, loop: Loop, car: Node) -> None:
    del loop, car
    robot.nodes[-1].kill()


def _speaks(robot: Side, loop: Loop, car: Node) -> None:
    del loop, car
    robot.nodes[-1].send("go")


FAULTS: Final[Mapping[str, tuple[Act, str, str]]] = {
    "gateway killed": (_killed("ros_gateway"), "", "the driver's own timeout"),
    "filter killed": (_killed("safety_filter"), "", "gateway: the gateway brakes: no action of the filter"),
    "adaptation killed": (_killed("adaptation"), "", "safety filter"),
    "router of the services killed": (_killed("router"), "", "gateway: the gateway brakes: no action of the filter"),
    "router of the robot killed": (_router, "", "the driver's own timeout"),
    "policy killed": (_policy, "policy", "safety filter"),
    "odometry ends": (_message("freeze"), "", "gateway: the gateway brakes: the odometry is"),
    "clock jumps back by 1000 s": (_message("rewind"), "", ""),
    "another publisher on /drive": (_speaks, "named", "publishes on /drive too"),
    "another publisher, without a token": (_speaks, "quiet", "who shows no token"),
}
"""By name: the fault, an additional participant, and the node that must report it; empty: the car need not brake."""


def run_fault(name: str, seed: int) -> dict[str, Any]:
    """One drive in which it happens while the car drives. Raises InputError for a fault that is not known."""
    if name not in FAULTS:
        raise InputError(f"fault '{name}': {did_you_mean(name, FAULTS)}")
    act, alongside, teller = FAULTS[name]
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        robot = stack.enter_context(side(Path(folder)))
        loop = stack.enter_context(services(Path(folder), router=True))
        car = robot.car(_LONGEST, seed, *(("--no-policy",) if alongside == "policy" else ()))
        if alongside == "policy":
            robot.speaker("/drive_in").send("go")
        loop.start("ros_gateway", str(robot_file(Path(folder) / "robot.toml", robot.endpoint, seed)))
        loop.wait_for("ros_gateway", "robot is on the bus")
        car.send("go")
        loop.wait_for("ros_gateway", "the filter drives")
        if alongside == "named":
            _late_speaker(robot)
        elif alongside == "quiet":
            robot.speaker("/drive", "--without-token")
        time.sleep(_BEFORE)
        car.send("mark")
        act(robot, loop, car)
        time.sleep(_AFTER)
        car.send("end")
        found = car.reported(_STARTS)
    return _judged(name, seed, found, teller)


def _late_speaker(robot: Side) -> None:
    """A participant that is the fault itself, so the fault starts it."""
    robot.nodes.append(_Later(robot))


class _Later(Node):
    """A speaker that starts on command."""

    def __init__(self, robot: Side) -> None:
        self._robot = robot

    def send(self, word: str) -> None:
        """Starts it, and lets it speak."""
        self._robot.speaker("/drive").send(word)

    def kill(self) -> None:
        """Nothing needs to be stopped."""


def _judged(name: str, seed: int, found: Mapping[str, Any], teller: str) -> dict[str, Any]:
    mark = found.get("mark")
    if mark is None:
        raise SafedpaError(f"{name}: the car was not notified when it happened")
    notice = [one for one in mark["notice"] if teller in one] if teller else []
    own = teller.startswith("the driver's") and found["driver_brakes"] > 0
    return {
        "fault": name,
        "seed": seed,
        "speed_before": mark["speed"],
        "stood_after": mark["stood_after"],
        "stopping_way": mark["stopping_way"],
        "told_after": mark["told_after"],
        "reported": notice[0] if notice else (teller if own else ""),
        "periods_braked_by_the_driver": found["driver_brakes"],
        "collisions": found["collisions"],
        "held": not found["collisions"] and (not teller or bool((notice or own) and mark["stood_after"] is not None)),
    }
