"""A node that speaks on a topic of drive commands: a policy of its own process, or someone who should not.

python -m safedpa_lab.ros.speaker PORT TOPIC [--without-token]
"""

from __future__ import annotations

import argparse
import json
import struct
import sys
import time
from collections.abc import Callable

import zenoh
from zenoh_ros2_sdk.publisher import ROS2Publisher

from safedpa_lab.ros.foreign import DRIVE, HASHES, address, session

_PERIOD = 0.04
_SPEED, _STEER = 1.5, 0.1


def _quiet_sender(port: int, topic: str) -> Callable[[float], None]:
    """Writes to the wire and shows no token: no one can ask who it is."""
    types = session(port).store
    settings = zenoh.Config()
    settings.insert_json5("mode", json.dumps("client"))
    settings.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    settings.insert_json5("scouting/multicast/enabled", "false")
    joined = zenoh.open(settings)
    key = f"0/{topic.strip('/')}/ackermann_msgs::msg::dds_::AckermannDriveStamped_/{HASHES[DRIVE]}"
    numbers = iter(range(1, 1 << 30))
    T = types.types

    def send(at: float) -> None:
        stamp = T["builtin_interfaces/msg/Time"](*divmod(int(at * 1e9), 10**9))
        drive = T["ackermann_msgs/msg/AckermannDrive"](_STEER, 0.0, _SPEED, 0.0, 0.0)
        message = T[DRIVE](T["std_msgs/msg/Header"](stamp, "odom"), drive)
        alongside = struct.pack("<qqB16s", next(numbers), int(at * 1e9), 16, b"no one knows him")
        joined.put(key, bytes(types.serialize_cdr(message, DRIVE)), attachment=alongside)

    return send


def _named_sender(port: int, topic: str) -> Callable[[float], None]:
    T = session(port).store.types
    speaks = ROS2Publisher(topic, DRIVE, type_hash=HASHES[DRIVE], node_name="speaker", **address(port))

    def send(at: float) -> None:
        stamp = T["builtin_interfaces/msg/Time"](*divmod(int(at * 1e9), 10**9))
        drive = T["ackermann_msgs/msg/AckermannDrive"](_STEER, 0.0, _SPEED, 0.0, 0.0)
        speaks.publish(header=T["std_msgs/msg/Header"](stamp, "odom"), drive=drive)

    return send


def _main() -> None:
    """Speaks until it is killed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("port", type=int)
    parser.add_argument("topic")
    parser.add_argument("--without-token", action="store_true")
    options = parser.parse_args()
    send = (_quiet_sender if options.without_token else _named_sender)(options.port, options.topic)
    sys.stdout.write("there\n")
    sys.stdout.flush()
    sys.stdin.readline()
    while True:
        send(time.time())
        time.sleep(_PERIOD)


if __name__ == "__main__":
    _main()
