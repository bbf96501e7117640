"""ROS interface of the car, commanded by Ackermann messages or Twist.

A Twist commands a speed v and a yaw rate w. The steering angle is atan(wheelbase w / v), as in Nav2 and in Gazebo's
Ackermann plugin; at very low speed it is 0, because a stationary car cannot turn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from safedpa.errors import InputError
from safedpa.ros.face import AbstractFace, Numbers

_STAMPED, _PLAIN = "ackermann_msgs/msg/AckermannDriveStamped", "ackermann_msgs/msg/AckermannDrive"
_TWIST, _TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
_PATHS = {
    _STAMPED: ("drive.speed", "drive.steering_angle"),
    _PLAIN: ("speed", "steering_angle"),
    _TWIST: ("linear.x", "angular.z"),
    _TWIST_STAMPED: ("twist.linear.x", "twist.angular.z"),
}
_SLOWEST = 0.05
"""m/s; below this speed a yaw rate does not define a steering angle."""


_HORIZON = 0.2
"""s; a throttle is published as the speed that it would reach in this time."""


class CarFace(AbstractFace):
    """The car with a speed servo: state x, y, yaw, speed; action target speed [m/s] and steering angle [rad]."""

    commands = tuple(_PATHS)

    def __init__(self, wheelbase: float = 0.32, steer_limit: float = 0.6) -> None:
        self._wheelbase, self._steer_limit = wheelbase, steer_limit

    def state(self, x: float, y: float, yaw: float, speed: float, yaw_rate: float) -> Numbers:  # noqa: D102
        del yaw_rate
        return (x, y, yaw, speed)

    def planar(self, values: Numbers) -> tuple[float, float, float, float, float]:  # noqa: D102
        return (values[0], values[1], values[2], values[3], 0.0)

    def paths(self, command: str) -> tuple[str, ...]:  # noqa: D102
        if command not in _PATHS:
            raise InputError(f"a car driven by {command}: wanted one of {', '.join(_PATHS)}")
        return _PATHS[command]

    def action(self, command: str, numbers: Numbers, state: Numbers) -> Numbers:  # noqa: D102
        del state
        speed, turn = numbers
        if command in (_STAMPED, _PLAIN):
            return (speed, turn)
        if abs(speed) < _SLOWEST:
            return (speed, 0.0)
        steer = math.atan(self._wheelbase * turn / speed)
        return (speed, max(-self._steer_limit, min(self._steer_limit, steer)))

    def message(self, command: str, action: Numbers, state: Numbers) -> Mapping[str, Any]:  # noqa: D102
        del state
        speed, steer = action
        if command in (_STAMPED, _PLAIN):
            drive = {"speed": speed, "steering_angle": steer}
            return {"drive": drive} if command == _STAMPED else drive
        twist = {"linear": {"x": speed}, "angular": {"z": speed * math.tan(steer) / self._wheelbase}}
        return {"twist": twist} if command == _TWIST_STAMPED else twist


class ThrottleCarFace(CarFace):
    """The car with a throttle: state x, y, yaw, speed; action throttle [-1, 1] and steering angle [rad].

    No standard ROS message holds a throttle. It is published as the speed that it would reach in 0.2 s without
    resistance, speed + 0.2 s drive_gain throttle. A received speed is converted back in the same way and clipped to
    full throttle.
    """

    needs_speed = True

    def __init__(self, drive_gain: float = 4.48, wheelbase: float = 0.32, steer_limit: float = 0.6) -> None:
        super().__init__(wheelbase, steer_limit)
        self._reach = _HORIZON * drive_gain

    def action(self, command: str, numbers: Numbers, state: Numbers) -> Numbers:  # noqa: D102
        speed, steer = super().action(command, numbers, state)
        return (max(-1.0, min(1.0, (speed - state[3]) / self._reach)), steer)

    def message(self, command: str, action: Numbers, state: Numbers) -> Mapping[str, Any]:  # noqa: D102
        now = state[3] if len(state) > 3 else 0.0
        return super().message(command, (now + self._reach * action[0], action[1]), state)

    def brake(self, command: str, resting: Numbers, state: Numbers) -> tuple[Numbers, Mapping[str, Any]]:
        """Returns the throttle that brakes to 0 within 0.2 s, and the message for speed 0.

        Throttle 0 would let the car roll and would be published as its current speed.
        """
        now = state[3] if len(state) > 3 else 0.0
        throttle = max(-1.0, min(1.0, -now / self._reach))
        return (throttle, resting[1]), CarFace.message(self, command, (0.0, resting[1]), ())
