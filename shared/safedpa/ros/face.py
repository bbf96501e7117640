"""How one kind of robot shows itself to ROS: its state out of odometry, its action as a command, and back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

__all__ = ["AbstractFace"]

Numbers = tuple[float, ...]


class AbstractFace(ABC):
    """A robot on the plane, as ROS sees one. A robot declares its own by ``AbstractRobot.ros_face``."""

    commands: tuple[str, ...]
    """Types of messages by which it is driven, the usual one first."""

    @abstractmethod
    def state(self, x: float, y: float, yaw: float, speed: float, yaw_rate: float) -> Numbers:
        """(states,) of a pose of its reference point, m and rad in the world, and its velocity in its own frame."""

    @abstractmethod
    def planar(self, values: Numbers) -> tuple[float, float, float, float, float]:
        """x, y, yaw, speed, yaw rate of (states,); the rate 0 where the state does not tell it."""

    @abstractmethod
    def paths(self, command: str) -> tuple[str, ...]:
        """Fields of a command that its action is made of."""

    @abstractmethod
    def action(self, command: str, numbers: Numbers, state: Numbers) -> Numbers:
        """(actions,) that a command asks for, whose fields are ``numbers``, in the state (states,)."""

    def brake(self, command: str, resting: Numbers, state: Numbers) -> tuple[Numbers, Mapping[str, Any]]:
        """The action that brings it to rest, and its command's fields; ``resting``: as its filter's settings say."""
        return resting, self.message(command, resting, state)

    @abstractmethod
    def message(self, command: str, action: Numbers, state: Numbers) -> Mapping[str, Any]:
        """Fields of the command that drives by ``action`` (actions,) in the state (states,)."""
