"""The controllers that a policy service can run, behind one method."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.errors import InputError, MessageError, did_you_mean
from safedpa.policy.backing_off import BackingOff
from safedpa.policy.compensation import SpeedCompensation
from safedpa.policy.goal_seeker import GoalSeeker, GoalSeekerSettings
from safedpa.policy.learned import LearnedPolicy
from safedpa.policy.network_latent import NetworkLatent
from safedpa.policy.point_seeker import PointSeeker
from safedpa.policy.random_wishes import RandomWishes

__all__ = ["CONTROLLERS", "CompensatedGoalSeeker", "Controller", "controller_for"]

CONTROLLERS: Final = ("goal_seeker", "learned", "planner", "random")
"""By name."""


class Controller(Protocol):
    """Wishes for the actions of one robot; it may remember what was before."""

    def wish(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """The wished action (actions,), and what the controller is called or about.

        ``latent`` (latents,) is that of the model, None when it is not known. Raises MessageError when the state does
        not fit.
        """


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


def controller_for(
    model: PhysicsModel, name: str | None = None, settings: GoalSeekerSettings | None = None
) -> Callable[[], Controller]:
    """What makes the controller of one robot; called anew for each. ``settings`` are the goal seeker's.

    Without a name: the learned policy when the model's weights hold one, else the goal seeker, for a pendulum random
    wishes. Raises InputError for a name that does not exist, for ``learned`` without a policy, and for a pendulum with
    what only drives.
    """
    base = model.base
    swings = model.system.name == "pendulum"
    if name is None:
        name = _default(model)
    if swings and name in ("goal_seeker", "planner"):
        raise InputError(f"controller '{name}': got a pendulum, wanted a car; choose random or learned")
    if name == "goal_seeker" and model.system.name == "point":
        return lambda: PointSeeker(model)
    if name == "goal_seeker":
        return lambda: CompensatedGoalSeeker(model, settings or GoalSeekerSettings())
    if name == "learned":
        if not isinstance(base, LearnedBase):
            raise InputError(
                "controller 'learned': the model has no networks, wanted one with a policy; choose another"
            )
        policy = NetworkLatent(LearnedPolicy(base.weights), model)
        if swings:
            return lambda: policy
        return lambda: BackingOff(policy)
    if name == "random":
        return lambda: RandomWishes(model)
    if name == "planner":
        from safedpa.policy.planner import Planner

        return lambda: Planner(model)
    raise InputError(f"controller '{name}': {did_you_mean(name, CONTROLLERS)}")


def _default(model: PhysicsModel) -> str:
    if isinstance(model.base, LearnedBase) and model.base.weights.has("policy"):
        return "learned"
    return "random" if model.system.name == "pendulum" else "goal_seeker"
