"""The policy service's step: wish[k] from state[k] and latent[k]."""

from __future__ import annotations

import time
from typing import final

import numpy as np
from numpy.typing import NDArray

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
from safedpa.policy.controller import Controller, controller_for
from safedpa.policy.goal_seeker import GoalSeekerSettings

__all__ = ["PolicyNode"]


@final
class PolicyNode(AbstractNode):
    """Wishes for actions that lead each robot to its goal, by one of the controllers of ``CONTROLLERS``.

    Without a name it is the learned policy when the model's weights hold one, else the goal seeker. A latent that does
    not belong to the model is left aside. Raises InputError for a controller that does not exist or lacks its weights.
    """

    name = "policy"
    inputs = (LATENT,)
    outputs = (WISH,)
    share = 0.2

    def __init__(
        self, model: PhysicsModel, settings: GoalSeekerSettings | None = None, controller: str | None = None
    ) -> None:
        self._make = controller_for(model, controller, settings)
        self._latents = len(model.latent_names)
        self._fingerprint = fingerprint(model)
        self._controllers: dict[str, Controller] = {}

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        if robot not in self._controllers:
            self._controllers[robot] = self._make()
        values, controller = self._controllers[robot].wish(state, self._latent(inputs))
        message = WishMessage(
            epoch=state.epoch,
            tick=state.tick,
            robot_time=state.robot_time,
            publish_time=time.time(),
            values=values,
            controller=controller,
        )
        return {WISH: message}

    def _latent(self, inputs: Inputs) -> NDArray[np.float64] | None:
        """The latent, if there is one and it belongs to the model."""
        latent = inputs[LATENT]
        if not isinstance(latent, LatentMessage) or latent.model != self._fingerprint:
            return None
        return np.array(latent.values) if len(latent.values) == self._latents else None

    def forget(self, robot: str) -> None:  # noqa: D102
        self._controllers.pop(robot, None)
