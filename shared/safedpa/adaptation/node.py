"""The node of the adaptation: computes latent[k] from the history up to state[k]."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple, final

import numpy as np

from safedpa.adaptation.abstract import AbstractEstimator
from safedpa.adaptation.estimator import EstimatorSettings, LatentEstimator
from safedpa.adaptation.history_estimator import HistoryEstimator
from safedpa.arrays import FloatArray
from safedpa.bus import (
    LATENT,
    TAKEOVER,
    Inputs,
    LatentMessage,
    ModelMessage,
    Outputs,
    StateMessage,
)
from safedpa.bus.messages.messages import header
from safedpa.bus.service.model_versions import ModelNode, ModelVersions
from safedpa.dynamics import LearnedBase, PhysicsModel, fingerprint
from safedpa.dynamics.model_offer import offered_model
from safedpa.errors import InputError, MessageError

__all__ = ["AdaptationNode"]


# Transitions from which the estimator of a new model is initialised; more than the history of an encoder.
_RECENT_TRANSITIONS = 64


class _AdaptationModel(NamedTuple):
    """A model with its fingerprint."""

    model: PhysicsModel
    fingerprint: str


class _Transition(NamedTuple):
    state: FloatArray
    action: FloatArray
    next_state: FloatArray
    period: float


@dataclass
class _EstimationState:
    estimator: AbstractEstimator
    tick: int = -1
    state: FloatArray | None = None
    """The newest state; None if it was implausible."""
    newest: StateMessage | None = None
    """The message from which ``afterwards`` learns."""
    recent: deque[_Transition] = field(default_factory=lambda: deque(maxlen=_RECENT_TRANSITIONS))
    """Consecutive transitions up to the newest state."""
    successor: tuple[_AdaptationModel, AbstractEstimator] | None = None
    """Estimator of the offered model, which is updated in parallel until that model is active."""


@final
class AdaptationNode(ModelNode[_AdaptationModel]):
    """Estimates the latent of the model for each robot from its states and applied actions.

    With a history encoder in the model's weights, latent[k] = phi(history up to state[k]). Otherwise the model's free
    parameters are estimated recursively, and latent[k] is based on the transitions before state[k]. The newest
    transition is processed after the latent was sent, so that the policy does not wait for it.

    Implausible states (outside the system's bounds) and the transitions from them are ignored. The estimate of a new
    model starts from the values of its file and the last transitions, before the model is active. Raises InputError if
    the settings do not fit the model.
    """

    name = "adaptation"
    inputs = ()
    outputs = (LATENT, TAKEOVER)
    share = 0.0

    def __init__(self, model: PhysicsModel, settings: EstimatorSettings | None = None) -> None:
        self._settings = settings
        self._robots: dict[str, _EstimationState] = {}
        first = _AdaptationModel(model, fingerprint(model))
        self._estimator(first)  # raises for settings that do not fit now, not at the first robot
        self._versions = ModelVersions(self.name, first, first.fingerprint, self._load)

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        del inputs
        changed = self._versions.begin(robot, state)
        held = self._versions.of(robot)
        _check(held, state)
        memory = self._robots.get(robot)
        if memory is None:
            memory = self._robots[robot] = _EstimationState(self._estimator(held))
        elif changed:
            ready = memory.successor is not None and memory.successor[0] is held
            memory.estimator = memory.successor[1] if ready and memory.successor else self._estimator(held)
            memory.successor = None
        memory.newest = state
        if memory.estimator.quick:
            try:
                self._learn(held, memory)
            except InputError as error:
                raise MessageError(f"state: {error}") from error
        return {LATENT: _message(held, state, memory.estimator)}

    def afterwards(self, robot: str) -> Outputs:
        """Processes the newest transition if that is slow; prepares an offered model and answers the offer."""
        memory = self._robots[robot]
        assert memory.newest is not None
        if not memory.estimator.quick:
            self._learn(self._versions.of(robot), memory)
        self._teach_successor(robot, memory)
        return self._answer(robot, memory.newest)

    def newest(self, robot: str) -> StateMessage | None:  # noqa: D102
        memory = self._robots.get(robot)
        return None if memory is None else memory.newest

    def _load(self, robot: str, offer: ModelMessage) -> _AdaptationModel:
        """Loads the offered model and tries it on the robot's last transitions. Raises InputError if it is unusable."""
        model = offered_model(offer, self._versions.of(robot).model)
        held = _AdaptationModel(model, offer.fingerprint)
        memory = self._robots.get(robot)
        estimator = self._estimator(held)
        if memory is not None:
            estimator.begin_with(tuple(memory.recent))
            memory.successor = (held, estimator)
        return held

    def _estimator(self, held: _AdaptationModel) -> AbstractEstimator:
        base = held.model.base
        if isinstance(base, LearnedBase) and base.weights.has("phi"):
            return HistoryEstimator(held.model)
        return LatentEstimator(held.model, self._settings)

    def _learn(self, held: _AdaptationModel, memory: _EstimationState) -> None:
        """Updates the estimator with the transition to the newest state."""
        state = memory.newest
        assert state is not None
        values, applied = np.array(state.values), np.array(state.applied)
        plausible = held.model.system.is_plausible_floats(state.values)
        if plausible and memory.state is not None and state.tick == memory.tick + 1:
            transition = _Transition(memory.state, applied, values, state.period)
            held.model.clock.seconds = state.robot_time - state.period
            memory.estimator.update(*transition)
            memory.recent.append(transition)
        else:
            memory.estimator.forget_transient()
            memory.recent.clear()
        memory.tick, memory.state = state.tick, values if plausible else None

    def _teach_successor(self, robot: str, memory: _EstimationState) -> None:
        """Updates the estimator of the offered model with the newest transition."""
        held = self._versions.prepared(robot)
        if memory.successor is None or memory.successor[0] is not held:
            memory.successor = None
        elif not memory.recent:
            memory.successor[1].forget_transient()
        else:
            try:
                memory.successor[1].update(*memory.recent[-1])
            except Exception:  # noqa: BLE001
                # A user's effect may raise anything. The change then starts with a new estimator.
                memory.successor = None

    def rescue(self, robot: str, state: StateMessage, reason: str) -> Outputs:
        """Returns no latent; policy and filter use the last one for a second. The estimate starts again."""
        # The estimator may be the cause of the failed step.
        del state, reason
        self._robots.pop(robot, None)
        return {}

    def forget(self, robot: str) -> None:  # noqa: D102
        self._robots.pop(robot, None)


def _check(held: _AdaptationModel, state: StateMessage) -> None:
    """Raises MessageError if the state or the applied action has the wrong length."""
    system = held.model.system
    if len(state.values) != len(system.state) or len(state.applied) != len(system.action):
        raise MessageError(
            f"state: got {len(state.values)} values and {len(state.applied)} actions, wanted "
            f"{len(system.state)} ({', '.join(system.state_names)}) and {len(system.action)}"
        )


def _message(held: _AdaptationModel, state: StateMessage, estimator: AbstractEstimator) -> LatentMessage:
    return LatentMessage(
        **header(state),
        model=held.fingerprint,
        values=tuple(estimator.latent.tolist()),
        deviations=tuple(estimator.deviations.tolist()),
    )
