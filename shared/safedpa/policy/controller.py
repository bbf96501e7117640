"""The interface of a controller, and the selection of a controller by name."""

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
from safedpa.systems.robots import Robot, robot_like

__all__ = ["Controller", "NetworkLatent", "RandomActions", "UsesSurroundings", "controller_for"]


@final
class RandomActions:
    """Uniformly random actions within the robot's nominal range, or the system's bounds; drawn again in each tick."""

    # The seed consists of the tick and the state's bytes. A drive in lockstep is therefore reproducible even if this
    # process restarts, and two robots in different states get different actions.

    def __init__(self, model: AbstractDynamics) -> None:
        system = model.system
        robot = robot_like(system)
        bounds = () if robot is None else robot.nominal_range
        if len(bounds) != len(system.action):
            bounds = tuple(zip(system.action_low.tolist(), system.action_high.tolist(), strict=True))
        self._low, self._high = np.array(bounds).T

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Returns the action (actions,) and the controller's name; ignores the latent."""
        del latent
        count = len(state.values)
        seed = struct.unpack(f"<{2 * count}I", struct.pack(f"<{count}d", *state.values))
        drawn = np.random.default_rng([state.tick, *seed]).uniform(self._low, self._high)
        return tuple(drawn.tolist()), "random"


@final
class NetworkLatent:
    """Passes the entries of the latent that its networks use to a learned policy.

    Effects added to a learned model, for example by a diagnosis, may have further free parameters.
    """

    def __init__(self, policy: LearnedPolicy, model: PhysicsModel) -> None:
        self._policy = policy
        names = model.latent_names
        self._entries = [index for index, path in enumerate(names) if path.startswith(f"base.{LATENT_PREFIX}")]

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Calls the policy with its part of the model's latent (latents,)."""
        return self._policy.nominal_action(state, None if latent is None else latent[self._entries])


class Controller(Protocol):
    """Computes the nominal actions of one robot; may have an internal state."""

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Returns the nominal action (actions,), and the controller's name, possibly with its current manoeuvre.

        ``latent`` (latents,) is the model's, None if unknown. Raises MessageError for a state that does not fit.
        """


@runtime_checkable
class UsesSurroundings(Protocol):
    """A controller that uses the surroundings from perception, for robots with sensors."""

    def look(self, seen: SurroundingsMessage | None) -> None:
        """Sets the surroundings for the next call of ``nominal_action``; None if they are unknown."""


def controller_for(model: PhysicsModel, name: str | None = None) -> Callable[[], Controller]:
    """Returns a factory of controllers for robots with this model; call it once per robot.

    Without a name, this is the learned policy if the model's weights have one, else the robot's default. Raises
    InputError for an unknown name, and for ``learned`` without a policy.
    """
    robot, base = robot_like(model.system), model.base
    own: Mapping[str, Callable[[], Controller]] = {} if robot is None else robot.controllers(model)
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


def _default(robot: Robot | None, own: Mapping[str, object]) -> str:
    return robot.default_controller if robot is not None and robot.default_controller in own else "random"
