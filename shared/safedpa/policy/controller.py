"""The controllers that a policy service can run, behind one method."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Protocol, final, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.dynamics import AbstractDynamics, LearnedBase, PhysicsModel
from safedpa.dynamics.settings import LATENT_PREFIX
from safedpa.errors import InputError, did_you_mean
from safedpa.policy.learned import LearnedPolicy
from safedpa.robot import AbstractRobot, robot_like

__all__ = ["Controller", "NetworkLatent", "RandomActions", "UsesSurroundings", "controller_for"]


@final
class RandomActions:
    """Uniform over the actuators' bounds, redrawn in each tick; of robots that declare none over the system's.

    The generator's seed is the tick with the state's bytes: so a drive in lockstep repeats, also where this process was
    restarted in between, and two robots in different states request different actions.
    """

    def __init__(self, model: AbstractDynamics) -> None:
        system = model.system
        robot = robot_like(system)
        bounds = () if robot is None else robot.nominal_range
        if len(bounds) != len(system.action):
            bounds = tuple(zip(system.action_low.tolist(), system.action_high.tolist(), strict=True))
        self._low, self._high = np.array(bounds).T

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """The action (actions,) and the controller's name; no latent is needed."""
        del latent
        count = len(state.values)
        seed = struct.unpack(f"<{2 * count}I", struct.pack(f"<{count}d", *state.values))
        drawn = np.random.default_rng([state.tick, *seed]).uniform(self._low, self._high)
        return tuple(drawn.tolist()), "random"


@final
class NetworkLatent:
    """Hands a learned policy the entries of the latent that its networks know.

    Effects that were added to a learned model, by a diagnosis say, may have free parameters of their own.
    """

    def __init__(self, policy: LearnedPolicy, model: PhysicsModel) -> None:
        self._policy = policy
        names = model.latent_names
        self._entries = [index for index, path in enumerate(names) if path.startswith(f"base.{LATENT_PREFIX}")]

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """As the policy, with the model's latent (latents,)."""
        return self._policy.nominal_action(state, None if latent is None else latent[self._entries])


class Controller(Protocol):
    """Computes the nominal actions of one robot; may keep state between calls."""

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """The requested action (actions,), and what the controller is called or about.

        ``latent`` (latents,) is that of the model, None when it is not known. Raises MessageError when the state does
        not fit.
        """


@runtime_checkable
class UsesSurroundings(Protocol):
    """A controller that is told what perception makes of the sensors, before each nominal action of a robot that names any."""

    def look(self, seen: SurroundingsMessage | None) -> None:
        """What is around the robot at the moment of the state that follows; None: no one knows."""


def controller_for(model: PhysicsModel, name: str | None = None) -> Callable[[], Controller]:
    """What makes the controller of one robot; called again for each.

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
        return lambda: RandomActions(model)
    if name not in own:
        known = (*own, "learned", "random")
        raise InputError(f"controller '{name}' of a {model.system.name}: {did_you_mean(name, known)}")
    return own[name]


def _default(robot: AbstractRobot | None, own: Mapping[str, object]) -> str:
    return robot.default_controller if robot is not None and robot.default_controller in own else "random"
