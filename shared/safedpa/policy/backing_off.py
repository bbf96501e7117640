"""A wrapper that makes a stuck car back off and try again.

A learned policy does not know which actions the filter corrects. It may request the same action forever while the car
is stationary. A car without progress therefore reverses for a moment with turned wheels, to alternating sides.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.errors import InputError

if TYPE_CHECKING:
    from safedpa.policy.controller import Controller

__all__ = ["BackOffController", "BackOffSettings"]


@dataclass(frozen=True)
class BackOffSettings:
    """When and how a car backs off, in SI units and radians."""

    patience_seconds: float = 1.0
    """Time without progress after which it backs off."""
    headway: float = 0.1
    """Distance in m within that time that counts as progress."""
    back_off_seconds: float = 1.4
    reverse_speed: float = -0.6
    steer: float = 0.34

    def __post_init__(self) -> None:
        positive = (self.patience_seconds, self.headway, self.back_off_seconds, self.steer)
        if not (min(positive) > 0.0 > self.reverse_speed):
            raise InputError(f"backing off: got {self}, wanted positive times, headway and steer, and a speed below 0")


@final
class BackOffController:
    """Passes on the nominal actions of another controller, and replaces them while a stuck car backs off.

    At the first attempt the heading turns towards the goal, at the next one away from it, and so on; a new goal resets
    the attempts.
    """

    def __init__(self, controller: Controller, settings: BackOffSettings | None = None) -> None:
        self._controller = controller
        self._settings = settings or BackOffSettings()
        self._history: deque[tuple[float, float, float]] = deque()
        self._until = -math.inf
        self._steer = 0.0
        self._attempts = 0
        self._goal: tuple[float, ...] = ()

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Returns the nominal action and the controller's name, with ``:back_off`` while the car backs off."""
        nominal, name = self._controller.nominal_action(state, latent)  # called every tick, as it may have a state
        now = state.robot_time
        if state.goal != self._goal:
            self._goal, self._attempts, self._until = state.goal, 0, -math.inf
            self._history.clear()
        if now >= self._until and self._is_held(now, *state.values[:2]):
            self._begin(now, state)
        if now >= self._until:
            return nominal, name
        return (self._settings.reverse_speed, self._steer), f"{name}:back_off"

    def _begin(self, now: float, state: StateMessage) -> None:
        x, y, yaw = state.values[:3]
        aside = math.sin(math.atan2(state.goal[1] - y, state.goal[0] - x) - yaw)
        towards = -1.0 if aside >= 0.0 else 1.0  # in reverse, the heading turns opposite to the steering angle
        self._steer = towards * self._settings.steer * (1.0 if self._attempts % 2 == 0 else -1.0)
        self._attempts += 1
        self._until = now + self._settings.back_off_seconds
        self._history.clear()

    def _is_held(self, now: float, x: float, y: float) -> bool:
        """Whether the car made no progress within the time limit."""
        self._history.append((now, x, y))
        while now - self._history[0][0] > self._settings.patience_seconds:
            self._history.popleft()
        oldest, past_x, past_y = self._history[0]
        watched = now - oldest >= 0.9 * self._settings.patience_seconds
        return watched and math.hypot(x - past_x, y - past_y) < self._settings.headway
