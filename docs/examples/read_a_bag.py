"""Writes a ROS 2 bag of a robot with a wrong track, reads it without ROS, and finds the error of the model.

python docs/examples/read_a_bag.py FOLDER [PICTURE.png]
"""

import sys
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import safedpa
from safedpa.dynamics import load_model, parse_model, write_model

PERIOD, SECONDS, RATIO = 0.05, 60.0, 1.15  # s, s, true track over the track of the model


def drive() -> tuple[np.ndarray, np.ndarray]:
    """States (k, 5) and commands (k, 2) of a drive of the real robot."""
    hidden = f'\n[[effects]]\nname = "track_error"\nratio = {RATIO}\n'
    real = parse_model(write_model(load_model("differential_drive")) + hidden)
    random, state, states, commands = np.random.default_rng(3), np.zeros(5), [], []
    for k in range(round(SECONDS / PERIOD)):
        if k % 20 == 0:
            command = random.uniform((0.0, -0.8), (0.5, 0.8))
        states.append(state + random.normal(0.0, (0.002, 0.002, 0.003, 0.01, 0.02)))
        commands.append(command)
        state = real.step(state, command)
    return np.array(states), np.array(commands)


def write(folder: Path, states: np.ndarray, commands: np.ndarray) -> None:
    """Writes /odom and /cmd_vel as ``ros2 bag record`` does."""
    store = get_typestore(Stores.ROS2_JAZZY)
    made = store.types

    def vector(x: float = 0.0, z: float = 0.0):
        return made["geometry_msgs/msg/Vector3"](x=x, y=0.0, z=z)

    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        odom = bag.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=store)
        velocity = bag.add_connection("/cmd_vel", "geometry_msgs/msg/Twist", typestore=store)
        for k, ((x, y, yaw, speed, turn_rate), (target, turn)) in enumerate(zip(states, commands, strict=True)):
            nanoseconds = 1_700_000_000_000_000_000 + round(k * PERIOD * 1e9)
            stamp = made["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))
            pose = made["geometry_msgs/msg/Pose"](
                position=made["geometry_msgs/msg/Point"](x=x, y=y, z=0.0),
                orientation=made["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=np.sin(yaw / 2), w=np.cos(yaw / 2)),
            )
            twist = made["geometry_msgs/msg/Twist"](linear=vector(x=speed), angular=vector(z=turn_rate))
            message = made["nav_msgs/msg/Odometry"](
                header=made["std_msgs/msg/Header"](stamp=stamp, frame_id="odom"),
                child_frame_id="base_link",
                pose=made["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
                twist=made["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
            )
            asked = made["geometry_msgs/msg/Twist"](linear=vector(x=target), angular=vector(z=turn))
            bag.write(velocity, nanoseconds, store.serialize_cdr(asked, asked.__msgtype__))
            bag.write(odom, nanoseconds, store.serialize_cdr(message, message.__msgtype__))


def main(arguments: list[str]) -> str:
    """Writes the bag to FOLDER/drive_bag, and diagnoses it."""
    folder = Path(arguments[0]) / "drive_bag"
    write(folder, *drive())
    found = safedpa.diagnose("differential_drive", folder, columns="turtlebot_bag")
    if arguments[1:]:
        found.plot().save(arguments[1])
    return f"{found}\n"


if __name__ == "__main__":
    sys.stdout.write(main(sys.argv[1:]))
