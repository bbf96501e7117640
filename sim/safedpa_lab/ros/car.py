"""A car that speaks ROS 2, as another implementation does it, with a policy of its own that looks at its goal alone.

    python -m safedpa_lab.ros.car PORT SECONDS SEED [--straight] [--no-policy] [--freeze-after S] ...

``--straight``: the policy drives by itself, past any filter. ``--speed``: the most that the policy asks for [m/s]. It
says ``there``, waits for a line ``go``, and prints one JSON line at its end. Further lines while it drives: ``mark``
(something happens now), ``freeze`` (its odometry ends), ``rewind`` (its clock jumps back), ``end``.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import sys
import threading
import time
from typing import Any

import numpy as np
from zenoh_ros2_sdk.publisher import ROS2Publisher
from zenoh_ros2_sdk.subscriber import ROS2Subscriber

from safedpa_lab.ros.foreign import DIAGNOSTICS, DRIVE, ODOMETRY, address, hash_of, session
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.car.world import CarWorld

_PERIOD = 0.02
_DRIVER_PATIENCE = 0.25
"""s; the driver brakes by itself without a command for so long."""
_STALL = 0.1
"""s; a period that begins later was delayed by this process or the machine: the drive goes on from there. Made up for
in a burst, the missed periods would be driven by one command; a gateway accepts no older odometry."""
_IS_STATIONARY = 0.05
"""m/s."""
_JUMP = 1000.0
"""s by which the clock jumps back."""


class Reported:
    """What reaches the robot: commands, and what the gateway and the filter say of themselves."""

    def __init__(self) -> None:
        self.command, self.commanded, self.commands = (0.0, 0.0), -math.inf, 0
        self.sent: dict[int, float] = {}
        """By the stamp of each odometry when it was sent."""
        self._arrived: dict[int, float] = {}
        self.sense_to_act: list[tuple[float, float]] = []
        """s from sending an odometry to the arrival of the command made of it; and how long that waited its turn."""
        self.notice: list[tuple[float, str]] = []
        """When something that is not well was reported, and what; once while it stays the same."""
        self._saying: dict[str, str] = {}
        self.braked_by_gateway = 0

    def drive(self, message: Any) -> None:
        """A command."""
        self.command = (float(message.drive.speed), float(message.drive.steering_angle))
        self.commanded = time.monotonic()
        self.commands += 1
        stamp = message.header.stamp
        self._arrived[stamp.sec * 10**9 + stamp.nanosec] = self.commanded

    def diagnose(self, message: Any) -> None:
        """What was reported of gateway or filter."""
        now = time.monotonic()
        for status in message.status:
            level = status.level if isinstance(status.level, int) else int.from_bytes(bytes(status.level), "little")
            notice = f"{status.name}: {status.message}" if level else ""
            if notice and notice[:40] != self._saying.get(status.name, "")[:40]:
                self.notice.append((now, notice))
            self._saying[status.name] = notice
            facts = {pair.key: pair.value for pair in status.values}
            if "command_stamp" not in facts:
                continue
            self.braked_by_gateway += bool(level)
            arrived, sent = self._arrived.get(int(facts["command_stamp"])), self.sent.get(int(facts["odometry_stamp"]))
            if arrived is not None and sent is not None and not level:
                self.sense_to_act.append((arrived - sent, float(facts["odometry_age"])))


class Car:
    """The car, its driver and its policy."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        scene = Scene.random(options.seed)
        self.world = CarWorld(scene.start, scene.field, scene.obstacles, None)
        self.goals = scene.goals()
        self.goal = next(self.goals)
        self.reached, self.brakes, self.stalled, self.moved, self.fastest = 0, 0, 0.0, 0.0, 0.0
        self.reported = Reported()
        self.begun = threading.Event()
        self.frozen, self.rewound, self.ended = False, False, False
        self.marked: dict[str, float] = {}
        self.T = session(options.port).store.types
        store, where = session(options.port).store, address(options.port)
        self.odometry = ROS2Publisher("/odom", ODOMETRY, type_hash=hash_of(store, ODOMETRY), node_name="base", **where)
        topic = "/drive" if options.straight else "/drive_in"
        self.policy = (
            None
            if options.no_policy
            else ROS2Publisher(topic, DRIVE, type_hash=hash_of(store, DRIVE), node_name="policy", **where)
        )
        hears = {"/drive": (DRIVE, self.reported.drive, "driver")}
        if not options.straight:
            hears["/diagnostics"] = (DIAGNOSTICS, self.reported.diagnose, "monitor")
        self.heard = [
            ROS2Subscriber(name, kind, call, type_hash=hash_of(store, kind), node_name=node, **where)
            for name, (kind, call, node) in hears.items()
        ]

    def listen(self) -> None:
        """Lines from anyone who started it."""
        for line in sys.stdin:
            self.obey(line.strip())

    def end(self) -> None:
        """Ends the drive, or does not begin it."""
        self.ended = True
        self.begun.set()

    def obey(self, word: str) -> None:
        """One of them."""
        if word == "go":
            self.begun.set()
        elif word == "freeze":
            self.frozen = True
        elif word == "rewind":
            self.rewound = True
        elif word == "end":
            self.end()
        elif word == "mark":
            self.marked = {"at": time.monotonic(), "moved": self.moved, "speed": abs(self.world.state[3])}

    def header(self) -> Any:
        """Of a message that is sent now."""
        T, ns = self.T, time.time_ns() - int(_JUMP * 1e9) * self.rewound
        return T["std_msgs/msg/Header"](T["builtin_interfaces/msg/Time"](*divmod(ns, 10**9)), "odom")

    def report(self) -> None:
        """Its odometry."""
        T, (x, y, yaw, speed) = self.T, self.world.state
        zeros, none = np.zeros(36), T["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        turned = T["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        pose = T["geometry_msgs/msg/Pose"](T["geometry_msgs/msg/Point"](x, y, 0.0), turned)
        twist = T["geometry_msgs/msg/Twist"](T["geometry_msgs/msg/Vector3"](speed, 0.0, 0.0), none)
        header = self.header()
        self.reported.sent[header.stamp.sec * 10**9 + header.stamp.nanosec] = time.monotonic()
        self.odometry.publish(
            header=header,
            child_frame_id="base_link",
            pose=T["geometry_msgs/msg/PoseWithCovariance"](pose, zeros),
            twist=T["geometry_msgs/msg/TwistWithCovariance"](twist, zeros),
        )

    def nominal_action(self) -> None:
        """Straight to the goal, as fast as it goes; obstacles are nothing to it."""
        if self.policy is None:
            return
        speed, steer = blind_policy(self.world.state, self.goal)
        speed = min(speed, self.options.speed)
        drive = self.T["ackermann_msgs/msg/AckermannDrive"](steer, 0.0, speed, 0.0, 0.0)
        self.policy.publish(header=self.header(), drive=drive)

    def turn(self, k: int, at: float) -> None:
        """One period, ``at`` s after the start."""
        options = self.options
        self.rewound = self.rewound or bool(options.rewind_after and at > options.rewind_after)
        if not self.frozen and not (options.freeze_after and at > options.freeze_after):
            self.report()
        if k % 2 == 0 and not (options.policy_ends and at > options.policy_ends):
            self.nominal_action()
        late = time.monotonic() - self.reported.commanded > _DRIVER_PATIENCE
        self.brakes += late
        speed, steer = (0.0, 0.0) if late else self.reported.command
        before = self.world.state
        self.world.advance(speed, steer, _PERIOD)
        x, y, _, now = self.world.state
        self.moved += math.hypot(x - before[0], y - before[1])
        self.fastest = max(self.fastest, abs(now))
        if self.marked and "stood" not in self.marked and abs(now) < _IS_STATIONARY:
            self.marked["stood"], self.marked["stopping_way"] = time.monotonic(), self.moved - self.marked["moved"]
        if math.hypot(x - self.goal[0], y - self.goal[1]) < 0.4:
            self.goal, self.reached = next(self.goals), self.reached + 1

    def run(self) -> dict[str, Any]:
        """Drives, and says what came of it."""
        start, k = time.monotonic(), 0
        while (at := time.monotonic() - start) < self.options.seconds and not self.ended:
            # Only the delay, not the whole time since the last period: the schedule would run ahead of the clock, and
            # its own waiting would count as the next delay.
            late = at - k * _PERIOD
            if late > _STALL:
                self.stalled += late
                start, at = start + late, at - late
            self.turn(k, at)
            k += 1
            time.sleep(max(0.0, start + k * _PERIOD - time.monotonic()))
        return self.account()

    def account(self) -> dict[str, Any]:
        """What came of the drive."""
        reported = self.reported
        found = {
            "collisions": len(self.world.collisions), "reached": self.reached, "moved": self.moved,
            "fastest": self.fastest, "commands": reported.commands, "driver_brakes": self.brakes,
            "gateway_brakes": reported.braked_by_gateway, "speed": self.world.state[3], "stalled": self.stalled,
            "notice": [notice for _, notice in reported.notice], "sense_to_act": reported.sense_to_act,
        }  # fmt: skip
        if self.marked:
            at = self.marked["at"]
            later = [(when - at, notice) for when, notice in reported.notice if when > at]
            found["mark"] = {
                "speed": self.marked["speed"],
                "stood_after": self.marked["stood"] - at if "stood" in self.marked else None,
                "stopping_way": self.marked.get("stopping_way"),
                "told_after": later[0][0] if later else None,
                "notice": [notice for _, notice in later],
            }
        return found


def blind_policy(state: tuple[float, float, float, float], goal: tuple[float, float]) -> tuple[float, float]:
    """Speed [m/s] and steering angle [rad] straight to the goal."""
    x, y, yaw, _ = state
    bearing = math.atan2(goal[1] - y, goal[0] - x) - yaw
    bearing = math.atan2(math.sin(bearing), math.cos(bearing))
    return 1.5, max(-0.3, min(0.3, bearing))


_OPTIONS = {
    "straight": "the policy drives by itself, past any filter",
    "no-policy": "no policy: a person or another program publishes on /drive_in",
}
_TIMES = {
    "freeze-after": "end the odometry after so many seconds",
    "policy-ends": "end the policy after so many seconds",
    "rewind-after": "let the clock jump back after so many seconds",
}


def _main() -> None:
    """One car; Ctrl-C ends its drive."""
    parser = argparse.ArgumentParser(description="A simulated car that speaks ROS 2. It drives once you type go.")
    parser.add_argument("port", type=int, help="TCP port of the robot's router")
    parser.add_argument("seconds", type=float, help="length of the drive")
    parser.add_argument("seed", type=int, help="seed of the scene; the robot file needs the same")
    for name, what in _OPTIONS.items():
        parser.add_argument(f"--{name}", action="store_true", help=what)
    for name, what in _TIMES.items():
        parser.add_argument(f"--{name}", type=float, default=0.0, metavar="S", help=what)
    parser.add_argument("--speed", type=float, default=math.inf, help="the most that the policy asks for [m/s]")
    found = Car(parser.parse_args())
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: found.end())
    threading.Thread(target=found.listen, daemon=True).start()
    sys.stdout.write("there\n")
    sys.stdout.flush()
    found.begun.wait()
    driven = found.run()
    sys.stdout.write(json.dumps(driven) + "\n")
    sys.stdout.flush()
    sys.stderr.write(f"collisions: {driven['collisions']}; goals: {driven['reached']}\n")
    os._exit(0)


if __name__ == "__main__":
    _main()
