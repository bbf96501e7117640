"""Bags written by another program (rosbags): a car's odometry and commands, as ROS 1 and ROS 2 store them."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

DRIVE = (
    "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n",
    "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n",
)
START = 1_700_000_000_000_000_000
PERIOD = 20_000_000
LATE = 3_000_000
"""ns from a stamp to its receipt."""


def store(kind: Stores = Stores.ROS2_JAZZY) -> Any:
    types = get_typestore(kind)
    types.register(get_types_from_msg(DRIVE[0], "ackermann_msgs/msg/AckermannDrive"))
    types.register(get_types_from_msg(DRIVE[1], "ackermann_msgs/msg/AckermannDriveStamped"))
    return types


def truth(rows: int) -> dict[str, np.ndarray]:
    """A drive along a curve, at 50 Hz; the command is that of every fifth row."""
    t = np.arange(rows) * PERIOD * 1e-9
    speed = 1.0 + 0.3 * np.sin(0.7 * t)
    steer = 0.2 * np.sin(0.5 * t)
    yaw = np.cumsum(speed * np.tan(steer) / 0.32) * PERIOD * 1e-9
    return {
        "x": np.cumsum(speed * np.cos(yaw)) * PERIOD * 1e-9,
        "y": np.cumsum(speed * np.sin(yaw)) * PERIOD * 1e-9,
        "yaw": yaw,
        "speed": speed,
        "target_speed": np.repeat((1.0 + 0.4 * np.sin(0.9 * t))[::5], 5)[:rows],
        "steer": np.repeat(steer[::5], 5)[:rows],
    }


def write(writer: Any, types: Any, rows: int, *, header: bool = True, frame: str = "odom", pictures: int = 0):
    """Fills a bag of rosbags with a drive; ``header``: whether stamps are set; ``pictures`` of a MiB in it."""
    T, drive = types.types, truth(rows)
    ros1 = "seq" in T["std_msgs/msg/Header"].__dataclass_fields__
    zeros, none = np.zeros(36), T["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    with writer:
        odom = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=types)
        command = writer.add_connection("/drive", "ackermann_msgs/msg/AckermannDriveStamped", typestore=types)
        camera = writer.add_connection("/camera", "sensor_msgs/msg/Image", typestore=types) if pictures else None
        for k in range(rows):
            at = START + k * PERIOD
            if camera is not None and k < pictures:
                writer.write(camera, at, np.random.default_rng(k).bytes(1 << 20))
            stamp = T["builtin_interfaces/msg/Time"](*divmod(at if header else 0, 10**9))
            extra = {"seq": k} if ros1 else {}
            head = T["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **extra)
            half = drive["yaw"][k] / 2
            place = T["geometry_msgs/msg/Pose"](
                position=T["geometry_msgs/msg/Point"](x=drive["x"][k], y=drive["y"][k], z=0.0),
                orientation=T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=math.sin(half), w=math.cos(half)),
            )
            along = T["geometry_msgs/msg/Vector3"](x=drive["speed"][k], y=0.0, z=0.0)
            message = T["nav_msgs/msg/Odometry"](
                header=head,
                child_frame_id="base_link",
                pose=T["geometry_msgs/msg/PoseWithCovariance"](pose=place, covariance=zeros),
                twist=T["geometry_msgs/msg/TwistWithCovariance"](
                    twist=T["geometry_msgs/msg/Twist"](linear=along, angular=none), covariance=zeros
                ),
            )
            if k % 5 == 0:
                reported = T["ackermann_msgs/msg/AckermannDrive"](
                    steering_angle=drive["steer"][k],
                    steering_angle_velocity=0.0,
                    speed=drive["target_speed"][k],
                    acceleration=0.0,
                    jerk=0.0,
                )
                asked = T["ackermann_msgs/msg/AckermannDriveStamped"](header=head, drive=reported)
                writer.write(command, at + LATE - 1, encoded(types, asked, ros1))
            writer.write(odom, at + LATE, encoded(types, message, ros1))
    return drive


def encoded(types: Any, message: Any, ros1: bool) -> bytes:
    encode = types.serialize_ros1 if ros1 else types.serialize_cdr
    return bytes(encode(message, message.__msgtype__))


def bag(path: Path, form: str, rows: int = 400, **options: Any) -> Path:
    """A bag of one of the forms: mcap, mcap-zstd, mcap-file, db3, db3-file, db3-message, bag, bag-bz2, bag-lz4."""
    kind, _, packed = form.partition("-")
    if kind == "bag":
        from rosbags.rosbag1 import Writer as Writer1

        path = path.with_suffix(".bag")
        writer: Any = Writer1(path)
        if packed:
            writer.set_compression(Writer1.CompressionFormat[packed.upper()])
        write(writer, store(Stores.ROS1_NOETIC), rows, **options)
        return path
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3)
    if packed:
        mode = {"file": CompressionMode.FILE, "message": CompressionMode.MESSAGE}.get(packed, CompressionMode.STORAGE)
        writer.set_compression(mode, CompressionFormat.ZSTD)
    write(writer, store(), rows, **options)
    return path
