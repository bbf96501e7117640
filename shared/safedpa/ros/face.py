"""Interface of one kind of robot to ROS: odometry to state, action to command, and back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from safedpa.errors import InputError

Numbers = tuple[float, ...]


class AbstractFace(ABC):
    """A robot on the plane as seen by ROS; ``AbstractRobot.ros_face`` returns that of a robot."""

    commands: tuple[str, ...]
    """Message types of its commands, the usual one first."""
    needs_speed: bool = False
    """Whether the command of an action depends on the measured speed: a wrong one makes it another action."""

    @abstractmethod
    def state(self, x: float, y: float, yaw: float, speed: float, yaw_rate: float) -> Numbers:
        """Returns the state (states,) for a pose of its reference point [m, rad] in the world and its body velocity."""

    def state_moving_aside(
        self, x: float, y: float, yaw: float, speed: float, aside: float, yaw_rate: float
    ) -> Numbers:
        """As ``state``, for a body that also moves to its left at ``aside`` [m/s]; a holonomic robot overrides it."""
        del aside
        return self.state(x, y, yaw, speed, yaw_rate)

    def aside(self, values: Numbers) -> float:
        """Returns the velocity to the left [m/s] of a state (states,); 0 unless the robot is holonomic."""
        del values
        return 0.0

    @abstractmethod
    def planar(self, values: Numbers) -> tuple[float, float, float, float, float]:
        """Returns x, y, yaw, speed and yaw rate of a state (states,); the yaw rate is 0 if the state has none."""

    @abstractmethod
    def paths(self, command: str) -> tuple[str, ...]:
        """Fields of a command message that determine the action."""

    @abstractmethod
    def action(self, command: str, numbers: Numbers, state: Numbers) -> Numbers:
        """Returns the action (actions,) of a command with the fields ``numbers``, in the state (states,)."""

    def brake(self, command: str, resting: Numbers, state: Numbers) -> tuple[Numbers, Mapping[str, Any]]:
        """Returns the braking action and its command; ``resting`` is the action at rest of the filter settings."""
        return resting, self.message(command, resting, state)

    @abstractmethod
    def message(self, command: str, action: Numbers, state: Numbers) -> Mapping[str, Any]:
        """Returns the fields of the command for ``action`` (actions,) in the state (states,)."""


_TWIST, _TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
_PATHS = {
    _TWIST: ("linear.x", "linear.y", "angular.z"),
    _TWIST_STAMPED: ("twist.linear.x", "twist.linear.y", "twist.angular.z"),
}


class HolonomicFace(AbstractFace):
    """A holonomic base, commanded by Twist with ``linear.y``.

    State: x, y, yaw, velocity ahead and to the left in the body frame, turn rate. Action: target velocities ahead and
    to the left [m/s], and turn rate [rad/s]. A robot with other states overrides ``state_moving_aside`` and ``planar``.

    Example:

        >>> from safedpa.ros.face import HolonomicFace
        >>> HolonomicFace().message("geometry_msgs/msg/Twist", (0.4, -0.2, 0.1), ())["linear"]
        {'x': 0.4, 'y': -0.2}
    """

    commands = tuple(_PATHS)

    def state(self, x: float, y: float, yaw: float, speed: float, yaw_rate: float) -> Numbers:  # noqa: D102
        return self.state_moving_aside(x, y, yaw, speed, 0.0, yaw_rate)

    def state_moving_aside(  # noqa: D102
        self, x: float, y: float, yaw: float, speed: float, aside: float, yaw_rate: float
    ) -> Numbers:
        return (x, y, yaw, speed, aside, yaw_rate)

    def aside(self, values: Numbers) -> float:  # noqa: D102
        return values[4]

    def planar(self, values: Numbers) -> tuple[float, float, float, float, float]:  # noqa: D102
        return (values[0], values[1], values[2], values[3], values[5])

    def paths(self, command: str) -> tuple[str, ...]:  # noqa: D102
        if command not in _PATHS:
            raise InputError(f"a holonomic robot driven by {command}: wanted one of {', '.join(_PATHS)}")
        return _PATHS[command]

    def action(self, command: str, numbers: Numbers, state: Numbers) -> Numbers:  # noqa: D102
        del command, state
        return (numbers[0], numbers[1], numbers[2])

    def message(self, command: str, action: Numbers, state: Numbers) -> Mapping[str, Any]:  # noqa: D102
        del state
        twist = {"linear": {"x": action[0], "y": action[1]}, "angular": {"z": action[2]}}
        return {"twist": twist} if command == _TWIST_STAMPED else twist
