"""The policy service's step: wish[k] from state[k] and latent[k]."""

from __future__ import annotations

import time
from typing import final

import numpy as np

from safedpa.bus import (
    LATENT,
    WISH,
    AbstractNode,
    Inputs,
    LatentMessage,
    Outputs,
    StateMessage,
    WishMessage,
)
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.errors import MessageError
from safedpa.policy.compensation import SpeedCompensation
from safedpa.policy.goal_seeker import GoalSeeker, GoalSeekerSettings

__all__ = ["PolicyNode"]


@final
class PolicyNode(AbstractNode):
    """Seeks each robot's goal, and makes up for what it tows as far as the latent is known."""

    name = "policy"
    inputs = (LATENT,)
    outputs = (WISH,)
    share = 0.2

    def __init__(self, model: PhysicsModel, settings: GoalSeekerSettings | None = None) -> None:
        self._compensation = SpeedCompensation(model)
        self._fingerprint = fingerprint(model)
        self._settings = settings or GoalSeekerSettings()
        self._seekers: dict[str, GoalSeeker] = {}

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        if len(state.values) != 4 or len(state.goal) != 2:
            raise MessageError(f"state: got {len(state.values)} values and a goal of {len(state.goal)}, wanted 4 and 2")
        seeker = self._seekers.setdefault(robot, GoalSeeker(self._settings))
        values = seeker.wish(state.robot_time, state.values, state.goal)
        latent = inputs[LATENT]
        if isinstance(latent, LatentMessage) and latent.model == self._fingerprint and self._fits(state, latent):
            values = self._compensated(state, values, latent)
        message = WishMessage(
            epoch=state.epoch,
            tick=state.tick,
            robot_time=state.robot_time,
            publish_time=time.time(),
            values=values,
            controller=f"goal_seeker:{seeker.mode}",
        )
        return {WISH: message}

    def _fits(self, state: StateMessage, latent: LatentMessage) -> bool:
        """Whether the model can be asked: the latent has its length, and the state can be believed."""
        model = self._compensation.model
        return len(latent.values) == len(model.latent_names) and model.system.is_plausible(np.array(state.values))

    def _compensated(
        self, state: StateMessage, wish: tuple[float, float], latent: LatentMessage
    ) -> tuple[float, float]:
        vectors = (np.array(state.values), np.array(wish), np.array(latent.values))
        speed, steer = self._compensation.compensated(*vectors)
        settings = self._settings
        return min(max(float(speed), settings.slowest_target), settings.fastest_target), float(steer)

    def forget(self, robot: str) -> None:  # noqa: D102
        self._seekers.pop(robot, None)
