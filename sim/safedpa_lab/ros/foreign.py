"""Another implementation of ROS 2 over Zenoh (zenoh-ros2-sdk), knowing the few types that a car needs."""

from __future__ import annotations

from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh_ros2_sdk.session import ZenohSession

ODOMETRY, DRIVE = "nav_msgs/msg/Odometry", "ackermann_msgs/msg/AckermannDriveStamped"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
HASHES = {
    ODOMETRY: "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    DRIVE: "RIHS01_48ca7612a08d3bb72744fd98b71b7cf2ea24c6ad50fa4e1aa0bbad963c90d8cf",
}
"""As published: CARLA's golden test, and ROS 2's own."""
_ACKERMANN = (
    "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n"
)


def session(port: int) -> Any:
    """The library's session, knowing the types without fetching them from anywhere."""
    found: Any = ZenohSession.get_instance("127.0.0.1", port)
    found.store = get_typestore(Stores.ROS2_JAZZY)
    found.store.register(get_types_from_msg(_ACKERMANN, "ackermann_msgs/msg/AckermannDrive"))
    found.store.register(get_types_from_msg("std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n", DRIVE))
    for name in found.store.types:
        found._registered_types[name] = name
    return found


def hash_of(store: Any, name: str) -> str:
    """As published where it was, else as the library of types computes it."""
    return HASHES.get(name) or f"RIHS01_{str(store.hash_rihs01(name)).removeprefix('RIHS01_')}"


def address(port: int) -> dict[str, Any]:
    """Where the robot's router is."""
    return {"router_ip": "127.0.0.1", "router_port": port}
