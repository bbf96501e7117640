"""Interface of one kind of robot to ROS: odometry to state, action to command, and back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

Numbers = tuple[float, ...]


class AbstractFace(ABC):
    """A robot on the plane as seen by ROS; ``AbstractRobot.ros_face`` returns that of a robot."""

    commands: tuple[str, ...]
    """Message types of its commands, the usual one first."""

    @abstractmethod
    def state(self, x: float, y: float, yaw: float, speed: float, yaw_rate: float) -> Numbers:
        """Returns the state (states,) for a pose of its reference point [m, rad] in the world and its body velocity."""

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
