"""The goal seeker of the car with what makes up for a towed load."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.dynamics import PhysicsModel
from safedpa.errors import MessageError
from safedpa.robots.car.compensation import SpeedCompensation
from safedpa.robots.car.goal_seeker import GoalSeeker, GoalSeekerSettings

__all__ = ["CompensatedGoalSeeker"]


@final
class CompensatedGoalSeeker:
    """The goal seeker, which makes up for what the robot tows as far as the latent is known."""

    def __init__(self, model: PhysicsModel, settings: GoalSeekerSettings) -> None:
        self._compensation = SpeedCompensation(model)
        self._settings = settings
        self._seeker = GoalSeeker(settings)

    def wish(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Target speed [m/s] and steer [rad]; the name tells what it is about, such as ``goal_seeker:seek``."""
        if len(state.values) != 4 or len(state.goal) != 2:
            raise MessageError(f"state: got {len(state.values)} values and a goal of {len(state.goal)}, wanted 4 and 2")
        values = self._seeker.wish(state.robot_time, state.values, state.goal)
        if latent is not None and self._compensation.model.system.is_plausible(np.array(state.values)):
            self._compensation.model.clock.seconds = state.robot_time
            speed = self._compensation.target(state.values, values, latent.tolist())
            values = min(max(speed, self._settings.slowest_target), self._settings.fastest_target), values[1]
        return values, f"goal_seeker:{self._seeker.mode}"
