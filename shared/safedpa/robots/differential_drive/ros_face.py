"""ROS interface of the differential drive, commanded by Twist."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from safedpa.errors import InputError
from safedpa.ros.face import AbstractFace, Numbers

_TWIST, _TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
_PATHS = {_TWIST: ("linear.x", "angular.z"), _TWIST_STAMPED: ("twist.linear.x", "twist.angular.z")}


class DifferentialDriveFace(AbstractFace):
    """State x, y, yaw, speed, turn rate; action target speed [m/s] and target turn rate [rad/s]."""

    commands = tuple(_PATHS)

    def state(self, x: float, y: float, yaw: float, speed: float, yaw_rate: float) -> Numbers:  # noqa: D102
        return (x, y, yaw, speed, yaw_rate)

    def planar(self, values: Numbers) -> tuple[float, float, float, float, float]:  # noqa: D102
        return (values[0], values[1], values[2], values[3], values[4])

    def paths(self, command: str) -> tuple[str, ...]:  # noqa: D102
        if command not in _PATHS:
            raise InputError(f"a differential drive driven by {command}: wanted one of {', '.join(_PATHS)}")
        return _PATHS[command]

    def action(self, command: str, numbers: Numbers, state: Numbers) -> Numbers:  # noqa: D102
        del command, state
        return (numbers[0], numbers[1])

    def message(self, command: str, action: Numbers, state: Numbers) -> Mapping[str, Any]:  # noqa: D102
        del state
        twist = {"linear": {"x": action[0]}, "angular": {"z": action[1]}}
        return {"twist": twist} if command == _TWIST_STAMPED else twist
