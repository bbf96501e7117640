"""The adaptation service's step: latent[k] from the history up to state[k]."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.adaptation.abstract import AbstractEstimator
from safedpa.adaptation.estimator import EstimatorSettings, LatentEstimator
from safedpa.adaptation.history_estimator import HistoryEstimator
from safedpa.bus import LATENT, AbstractNode, Inputs, LatentMessage, Outputs, StateMessage
from safedpa.dynamics import LearnedBase, PhysicsModel, fingerprint
from safedpa.errors import InputError, MessageError

__all__ = ["AdaptationNode"]

Vector = NDArray[np.float64]


@dataclass
class _Memory:
    estimator: AbstractEstimator
    tick: int = -1
    state: Vector | None = None
    """None until a state came that can be believed."""
    newest: StateMessage | None = None
    """What ``afterwards`` has to learn from."""


@final
class AdaptationNode(AbstractNode):
    """Estimates the latent of the model for each robot from its states and the actions in force.

    With a history encoder among the model's weights, latent[k] = phi(history up to state[k]). Without, the model's free
    parameters are estimated recursively, and latent[k] holds what all transitions before state[k] taught: the newest
    one is learned while the policy computes, so that nobody waits for it.

    A state that cannot be believed (out of the system's bounds) teaches nothing, nor does the transition out of it.
    Raises InputError when the settings do not fit the model.
    """

    name = "adaptation"
    inputs = ()
    outputs = (LATENT,)
    share = 0.0

    def __init__(self, model: PhysicsModel, settings: EstimatorSettings | None = None) -> None:
        self._model = model
        self._settings = settings or EstimatorSettings()
        self._fingerprint = fingerprint(model)
        self._robots: dict[str, _Memory] = {}
        self._estimator()  # says now, not at the first robot, that the settings do not fit

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        del inputs
        self._check(state)
        memory = self._robots.get(robot)
        if memory is None:
            memory = self._robots[robot] = _Memory(self._estimator())
        memory.newest = state
        if memory.estimator.quick:
            try:
                self._learn(memory)
            except InputError as error:
                raise MessageError(f"state: {error}") from error
        return {LATENT: self._message(state, memory.estimator)}

    def afterwards(self, robot: str) -> Outputs:
        """Learns from the newest transition, where that takes time."""
        memory = self._robots[robot]
        if not memory.estimator.quick:
            self._learn(memory)
        return {}

    def _estimator(self) -> AbstractEstimator:
        base = self._model.base
        if isinstance(base, LearnedBase) and base.weights.has("phi"):
            return HistoryEstimator(self._model)
        return LatentEstimator(self._model, self._settings)

    def _learn(self, memory: _Memory) -> None:
        """Learns from the transition to the newest state."""
        state = memory.newest
        assert state is not None
        values, applied = np.array(state.values), np.array(state.applied)
        plausible = self._model.system.is_plausible(values)
        if plausible and memory.state is not None and state.tick == memory.tick + 1:
            memory.estimator.update(memory.state, applied, values, state.period)
        else:
            memory.estimator.forget_transient()
        memory.tick, memory.state = state.tick, values if plausible else None

    def forget(self, robot: str) -> None:  # noqa: D102
        self._robots.pop(robot, None)

    def _check(self, state: StateMessage) -> None:
        """Raises MessageError when the lengths of state or action in force do not fit."""
        system = self._model.system
        if len(state.values) != len(system.state) or len(state.applied) != len(system.action):
            raise MessageError(
                f"state: got {len(state.values)} values and {len(state.applied)} actions, wanted "
                f"{len(system.state)} ({', '.join(system.state_names)}) and {len(system.action)}"
            )

    def _message(self, state: StateMessage, estimator: AbstractEstimator) -> LatentMessage:
        return LatentMessage(
            epoch=state.epoch,
            tick=state.tick,
            robot_time=state.robot_time,
            publish_time=time.time(),
            model=self._fingerprint,
            values=tuple(float(value) for value in estimator.latent),
            deviations=tuple(float(value) for value in estimator.deviations),
        )
