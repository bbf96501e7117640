"""The node of the policy: computes nominal action[k] from state[k] and latent[k]."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import (
    LATENT,
    NOMINAL,
    SURROUNDINGS,
    TAKEOVER,
    Inputs,
    LatentMessage,
    ModelMessage,
    NominalMessage,
    Outputs,
    StateMessage,
    SurroundingsMessage,
    Topic,
)
from safedpa.bus.messages.messages import header
from safedpa.bus.service.model_versions import ModelNode, ModelVersions
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.dynamics.model_offer import offered_model
from safedpa.policy.controller import Controller, UsesSurroundings, controller_for

__all__ = ["PolicyNode"]


@dataclass(frozen=True)
class _PolicyModel:
    """A model with its fingerprint and the factory of its controllers."""

    model: PhysicsModel
    fingerprint: str
    make: Callable[[], Controller]


class _RobotController(NamedTuple):
    """The controller of one robot."""

    controller: Controller
    looks: UsesSurroundings | None
    """The same object if it uses surroundings. Tested once, because isinstance of a protocol is slow."""


@final
class PolicyNode(ModelNode[_PolicyModel]):
    """Computes nominal actions that lead each robot to its goal, by one of the robot's controllers.

    Without a name this is the learned policy if the model's weights have one, else the robot's default. A latent of
    another model is ignored. Raises InputError for an unknown controller, or one without weights.
    """

    name = "policy"
    inputs = (LATENT,)
    outputs = (NOMINAL, TAKEOVER)
    share = 0.2
    # The latent may be one tick old: a load does not change within a tick, and waiting for the adaptation would take a
    # quarter of the time from sense to act. Surroundings may be two ticks old: the route is planned for seconds.
    slack: ClassVar[Mapping[Topic, int]] = {LATENT: 1, SURROUNDINGS: 2}
    sensor_inputs = (SURROUNDINGS,)
    defers_afterwards = False

    def __init__(self, model: PhysicsModel, controller: str | None = None) -> None:
        self._controller = controller
        first = self._held(model)
        self._looks = isinstance(first.make(), UsesSurroundings)
        self._versions = ModelVersions(self.name, first, first.fingerprint, self._load)
        self._controllers: dict[str, _RobotController] = {}
        self._states: dict[str, StateMessage] = {}

    def needs(self, state: StateMessage) -> tuple[Topic, ...]:
        """Returns the needed inputs; surroundings only if the controller uses them."""
        return super().needs(state) if self._looks else self.inputs

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        if self._versions.begin(robot, state):
            self._controllers.pop(robot, None)
        held = self._versions.of(robot)
        self._states[robot] = state
        driven = self._controllers.get(robot)
        if driven is None:
            made = held.make()
            driven = self._controllers[robot] = _RobotController(
                made, made if isinstance(made, UsesSurroundings) else None
            )
        if driven.looks is not None:
            seen = inputs.get(SURROUNDINGS)
            driven.looks.look(seen if isinstance(seen, SurroundingsMessage) else None)
        values, controller = driven.controller.nominal_action(state, _latent(held, inputs))
        return {NOMINAL: NominalMessage(**header(state), values=values, controller=controller, model=held.fingerprint)}

    def afterwards(self, robot: str) -> Outputs:
        """Prepares an offered model and answers the offer."""
        return self._answer(robot, self._states[robot])

    def newest(self, robot: str) -> StateMessage | None:  # noqa: D102
        return self._states.get(robot)

    def rescue(self, robot: str, state: StateMessage, reason: str) -> Outputs:
        """Returns no nominal action, so that the filter brakes. The controller starts again."""
        # Its internal state may be the cause of the failed step.
        del state, reason
        self._controllers.pop(robot, None)
        return {}

    def forget(self, robot: str) -> None:  # noqa: D102
        self._controllers.pop(robot, None)
        self._states.pop(robot, None)

    def _held(self, model: PhysicsModel) -> _PolicyModel:
        return _PolicyModel(model, fingerprint(model), controller_for(model, self._controller))

    def _load(self, robot: str, offer: ModelMessage) -> _PolicyModel:
        """Loads the offered model and tries it at the robot's newest state. Raises InputError if it is unusable."""
        held = self._held(offered_model(offer, self._versions.of(robot).model))
        state = self._states.get(robot)
        if state is not None:
            held.make().nominal_action(state, held.model.latent)
        return held


def _latent(held: _PolicyModel, inputs: Inputs) -> NDArray[np.float64] | None:
    """Returns the latent if there is one and it belongs to the model."""
    latent = inputs[LATENT]
    if not isinstance(latent, LatentMessage) or latent.model != held.fingerprint:
        return None
    return np.array(latent.values) if len(latent.values) == len(held.model.latent_names) else None
