"""The goal seeker of a car without a speed servo: a speed controller in between asks the model for the throttle."""

from __future__ import annotations

from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError, MessageError
from safedpa.robots.car.goal_seeker import GoalSeeker, GoalSeekerSettings
from safedpa.robots.car.throttle import throttle_for

__all__ = ["ThrottledGoalSeeker"]

_GAIN: Final = 3.0
"""1/s; of the speed controller."""
_MOST: Final = 2.0
"""m/s2 that it asks for at most."""
_BOUNDS: Final = (-1.0, 1.0)
"""Of the throttle."""


@final
class ThrottledGoalSeeker:
    """The goal seeker; its target speed becomes a wished acceleration clip(3/s (target - speed), +-2 m/s2), and that,
    by the model with the newest latent, a throttle.
    """

    def __init__(self, model: PhysicsModel, settings: GoalSeekerSettings) -> None:
        self._model, self._seeker = model, GoalSeeker(settings)

    def wish(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Throttle and steer [rad]; the name tells what it is about, such as ``goal_seeker:seek``."""
        if len(state.values) != 4 or len(state.goal) != 2:
            raise MessageError(f"state: got {len(state.values)} values and a goal of {len(state.goal)}, wanted 4 and 2")
        target, steer = self._seeker.wish(state.robot_time, state.values, state.goal)
        values, wanted = np.array(state.values), min(max(_GAIN * (target - state.values[3]), -_MOST), _MOST)
        throttle = 0.0
        if self._model.system.is_plausible(values):
            self._model.clock.seconds = state.robot_time
            try:
                throttle = throttle_for(self._model, values, steer, wanted, _BOUNDS, latent)
            except InputError as error:
                raise MessageError(f"state: {error}") from error
        return (throttle, steer), f"goal_seeker:{self._seeker.mode}"
