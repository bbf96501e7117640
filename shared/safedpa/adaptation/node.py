"""The adaptation service's step: latent[k] from the history up to state[k]."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, final

import numpy as np

from safedpa.adaptation.abstract import AbstractEstimator
from safedpa.adaptation.estimator import EstimatorSettings, LatentEstimator
from safedpa.adaptation.history_estimator import HistoryEstimator
from safedpa.arrays import FloatArray
from safedpa.bus import (
    LATENT,
    MODEL,
    TAKEOVER,
    AbstractNode,
    Answer,
    Inputs,
    LatentMessage,
    Message,
    ModelMessage,
    Outputs,
    StateMessage,
)
from safedpa.bus.service.model_versions import ModelVersions
from safedpa.bus.service.sandbox import AbstractJobHandle
from safedpa.dynamics import LearnedBase, PhysicsModel, fingerprint
from safedpa.dynamics.model_offer import offered_model
from safedpa.errors import InputError, MessageError

__all__ = ["AdaptationNode"]


_RECENT_TRANSITIONS = 64
"""From which an estimator of a new model begins: longer than the history that an encoder reads."""


class _AdaptationModel(NamedTuple):
    """What the adaptation needs of a model."""

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
    """None until a state came that can be believed."""
    newest: StateMessage | None = None
    """What ``afterwards`` has to learn from."""
    recent: deque[_Transition] = field(default_factory=lambda: deque(maxlen=_RECENT_TRANSITIONS))
    """Without a gap, up to the newest state."""
    successor: tuple[_AdaptationModel, AbstractEstimator] | None = None
    """For the model that was offered; it learns along until that model is in force."""


@final
class AdaptationNode(AbstractNode):
    """Estimates the latent of the model for each robot from its states and the actions in force.

    With a history encoder among the model's weights, latent[k] = phi(history up to state[k]). Without, the model's free
    parameters are estimated recursively, and latent[k] holds what all transitions before state[k] taught: the newest
    one is learned while the policy computes, so that no one waits for it.

    A state that cannot be believed (out of the system's bounds) teaches nothing, nor does the transition out of it. A
    new model's estimate begins with the values of its file and learns from the last transitions, before it is used.
    Raises InputError when the settings do not fit the model.
    """

    name = "adaptation"
    inputs = ()
    outputs = (LATENT, TAKEOVER)
    listens = (MODEL,)
    share = 0.0

    def __init__(self, model: PhysicsModel, settings: EstimatorSettings | None = None) -> None:
        self._settings = settings
        self._robots: dict[str, _EstimationState] = {}
        first = _AdaptationModel(model, fingerprint(model))
        self._estimator(first)  # says now, not at the first robot, that the settings do not fit
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
        """Learns from the newest transition, where that takes time; prepares a model that was offered, and answers."""
        memory = self._robots[robot]
        assert memory.newest is not None
        if not memory.estimator.quick:
            self._learn(self._versions.of(robot), memory)
        self._teach_successor(robot, memory)
        answer = self._versions.answer(robot, memory.newest)
        return {} if answer is None else {TAKEOVER: answer}

    def hear(self, robot: str, message: Message) -> None:  # noqa: D102
        assert isinstance(message, ModelMessage)
        self._versions.hear(robot, message)

    def try_apart(self, hand_in: Callable[[str, ModelMessage], AbstractJobHandle]) -> None:  # noqa: D102
        self._versions.hand_in = hand_in

    def newest(self, robot: str) -> StateMessage | None:  # noqa: D102
        memory = self._robots.get(robot)
        return None if memory is None else memory.newest

    def welcome(self, robot: str, status: Answer | None) -> None:  # noqa: D102
        self._versions.welcome(robot, status)

    def agreed(self, robot: str) -> Answer | None:  # noqa: D102
        return self._versions.agreed(robot)

    def model_of(self, robot: str) -> str:  # noqa: D102
        return self._versions.fingerprint(robot)

    def _load(self, robot: str, offer: ModelMessage) -> _AdaptationModel:
        """The offered model, tried on the robot's last transitions. Raises InputError when it cannot be used."""
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
        """Learns from the transition to the newest state."""
        state = memory.newest
        assert state is not None
        values, applied = np.array(state.values), np.array(state.applied)
        plausible = held.model.system.believes(state.values)
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
        """The newest transition for the model that was offered, too."""
        held = self._versions.prepared(robot)
        if memory.successor is None or memory.successor[0] is not held:
            memory.successor = None
        elif not memory.recent:
            memory.successor[1].forget_transient()
        else:
            try:
                memory.successor[1].update(*memory.recent[-1])
            except Exception:  # noqa: BLE001  a user's effect may raise anything; the change begins with a fresh one then
                memory.successor = None

    def rescue(self, robot: str, state: StateMessage, reason: str) -> Outputs:
        """No latent: the others have the last one for a second. What was learned may be broken, so it begins again."""
        del state, reason
        self._robots.pop(robot, None)
        return {}

    def forget(self, robot: str) -> None:  # noqa: D102
        self._robots.pop(robot, None)

    def leave(self, robot: str) -> None:  # noqa: D102
        self.forget(robot)
        self._versions.forget(robot)


def _check(held: _AdaptationModel, state: StateMessage) -> None:
    """Raises MessageError when the lengths of state or action in force do not fit."""
    system = held.model.system
    if len(state.values) != len(system.state) or len(state.applied) != len(system.action):
        raise MessageError(
            f"state: got {len(state.values)} values and {len(state.applied)} actions, wanted "
            f"{len(system.state)} ({', '.join(system.state_names)}) and {len(system.action)}"
        )


def _message(held: _AdaptationModel, state: StateMessage, estimator: AbstractEstimator) -> LatentMessage:
    return LatentMessage(
        epoch=state.epoch,
        tick=state.tick,
        robot_time=state.robot_time,
        publish_time=time.time(),
        model=held.fingerprint,
        values=tuple(estimator.latent.tolist()),
        deviations=tuple(estimator.deviations.tolist()),
    )
