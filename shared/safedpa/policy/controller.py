"""The controllers that a policy service can run, behind one method."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.errors import InputError, did_you_mean
from safedpa.policy.learned import LearnedPolicy
from safedpa.policy.network_latent import NetworkLatent
from safedpa.policy.random_wishes import RandomWishes
from safedpa.robot import AbstractRobot, robot_like

__all__ = ["Controller", "controller_for"]


class Controller(Protocol):
    """Wishes for the actions of one robot; it may remember what was before."""

    def wish(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """The wished action (actions,), and what the controller is called or about.

        ``latent`` (latents,) is that of the model, None when it is not known. Raises MessageError when the state does
        not fit.
        """


def controller_for(model: PhysicsModel, name: str | None = None) -> Callable[[], Controller]:
    """What makes the controller of one robot; called anew for each.

    Without a name: the learned policy when the model's weights hold one, else the robot's own default. Raises
    InputError for a name that this robot does not have, and for ``learned`` without a policy.
    """
    robot, base = robot_like(model.system), model.base
    own = {} if robot is None else robot.controllers(model)
    if name is None:
        taught = isinstance(base, LearnedBase) and base.weights.has("policy")
        name = "learned" if taught else _default(robot, own)
    if name == "learned":
        if not isinstance(base, LearnedBase):
            raise InputError(
                "controller 'learned': the model has no networks, wanted one with a policy; choose another"
            )
        policy = NetworkLatent(LearnedPolicy(base.weights), model)
        return lambda: policy if robot is None else robot.learned(policy)
    if name == "random":
        return lambda: RandomWishes(model)
    if name not in own:
        known = (*own, "learned", "random")
        raise InputError(f"controller '{name}' of a {model.system.name}: {did_you_mean(name, known)}")
    return own[name]


def _default(robot: AbstractRobot | None, own: Mapping[str, object]) -> str:
    return robot.default_controller if robot is not None and robot.default_controller in own else "random"
