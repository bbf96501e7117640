"""The policy service's step: wish[k] from state[k] and latent[k]."""

from __future__ import annotations

import time
from typing import final

from safedpa.bus import LATENT, WISH, AbstractNode, Inputs, Outputs, StateMessage, WishMessage
from safedpa.policy.goal_seeker import GoalSeeker, GoalSeekerSettings

__all__ = ["PolicyNode"]


@final
class PolicyNode(AbstractNode):
    """Seeks each robot's goal. The goal seeker needs no latent, so a missing one does not stop it."""

    name = "policy"
    inputs = (LATENT,)
    outputs = (WISH,)
    share = 0.2

    def __init__(self, settings: GoalSeekerSettings | None = None) -> None:
        self._settings = settings or GoalSeekerSettings()
        self._seekers: dict[str, GoalSeeker] = {}

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        del inputs
        seeker = self._seekers.setdefault(robot, GoalSeeker(self._settings))
        values = seeker.wish(state.robot_time, state.values, state.goal)
        message = WishMessage(
            epoch=state.epoch,
            tick=state.tick,
            robot_time=state.robot_time,
            publish_time=time.time(),
            values=values,
            controller=f"goal_seeker:{seeker.mode}",
        )
        return {WISH: message}

    def forget(self, robot: str) -> None:  # noqa: D102
        self._seekers.pop(robot, None)
