"""The goal seeker of the car, whose wishes the model with the newest latent turns into what brings them about.

With a speed servo it makes up for a towed load: it drives so that the loaded robot behaves as the unloaded one would.

Let v be the entry of the state that an action's entry u steers directly (the speed, for a target speed). The nominal
model, with the latent at the values of its file, would move it to v+ under the wish u. With the estimated latent z the
model says v+ = f_v(x, z) + g_v(x, z) u', so u' = (v+ - f_v) / g_v does the same with load, as far as the bounds allow.

Without a servo a speed controller in between asks the model for the throttle.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any, Final, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError, MessageError
from safedpa.robots.car.goal_seeker import GoalSeeker, GoalSeekerSettings
from safedpa.robots.car.throttle import throttle_for

__all__ = ["CompensatedGoalSeeker", "SpeedCompensation", "ThrottledGoalSeeker"]

Values: TypeAlias = NDArray[np.float64]

_NUDGE = 1e-3
"""m/s of target speed, for the slope."""
_WEAKEST = 1e-3
"""Below this sensitivity d(v+)/du the action has no hold on the speed, and the wish stays as it is."""

_GAIN: Final = 3.0
"""1/s; of the speed controller."""
_MOST: Final = 2.0
"""m/s2 that it asks for at most."""
_BOUNDS: Final = (-1.0, 1.0)
"""Of the throttle."""


@final
class SpeedCompensation:
    """Replaces the target speed of a wish by the one that has the wished effect under the latent."""

    def __init__(self, model: PhysicsModel) -> None:
        self.model = model
        self._nominal = model.latent
        self._nominal_entries: list[float] = model.latent.tolist()
        self._speed = model.system.state_names.index("speed")
        self._target = model.system.action_names.index("target_speed")

    def compensated(self, state: Values, wish: Values, latent: Values) -> Values:
        """The wish (actions,) with another target speed [m/s], for state (states,) and latent (latents,)."""
        changed = wish.copy()
        changed[self._target] = self.target(state.tolist(), wish.tolist(), latent.tolist())
        return changed

    def target(self, state: Sequence[float], wish: Sequence[float], latent: Sequence[float]) -> float:
        """The target speed alone, over plain numbers."""
        loaded, unloaded, hold = self._speeds(state, wish, latent)
        asked = wish[self._target]
        return asked + (unloaded - loaded) / hold if hold > _WEAKEST else asked

    def _speeds(
        self, state: Sequence[float], wish: Sequence[float], latent: Sequence[float]
    ) -> tuple[float, float, float]:
        """The speed after the wish with the load and without, and its slope over the target speed with the load.

        Three steps of the model, which are the same to the last bit on each of its roads: a run repeats itself,
        whenever the straight line of arithmetic is ready.
        """
        nudged = list(wish)
        nudged[self._target] += _NUDGE
        step, speed = self.model.straight(self.model.period), self._speed
        if step is not None:
            with contextlib.suppress(ValueError, ArithmeticError):  # numbers that the other road answers
                now = self.model.clock.seconds
                loaded = step(state, wish, latent, now)[speed]
                beyond = step(state, nudged, latent, now)[speed]
                return loaded, step(state, wish, self._nominal_entries, now)[speed], (beyond - loaded) / _NUDGE
        at, wished, further, known = np.array(state), np.array(wish), np.array(nudged), np.array(latent)
        memory = self.model.initial_memory(wished, known)
        loaded = self._speed_after(at, wished, memory, known)
        slope = (self._speed_after(at, further, memory, known) - loaded) / _NUDGE
        unloaded = self._speed_after(at, wished, self.model.initial_memory(wished, self._nominal), self._nominal)
        return loaded, unloaded, slope

    def _speed_after(self, state: Values, wish: Values, memory: Any, latent: Values) -> float:
        return float(self.model.advance(state, wish, memory, latent)[0][self._speed])


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
        if latent is not None and self._compensation.model.system.believes(state.values):
            self._compensation.model.clock.seconds = state.robot_time
            speed = self._compensation.target(state.values, values, latent.tolist())
            values = min(max(speed, self._settings.slowest_target), self._settings.fastest_target), values[1]
        return values, f"goal_seeker:{self._seeker.mode}"


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
