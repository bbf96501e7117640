"""The adaptation service's step: latent[k] from the history up to state[k]."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.adaptation.estimator import EstimatorSettings, LatentEstimator
from safedpa.bus import LATENT, AbstractNode, Inputs, LatentMessage, Outputs, StateMessage
from safedpa.dynamics import PhysicsModel, fingerprint

__all__ = ["AdaptationNode"]


@dataclass
class _Memory:
    estimator: LatentEstimator
    tick: int
    state: NDArray[np.float64]


@final
class AdaptationNode(AbstractNode):
    """Estimates the free parameters of the model for each robot from its states and the actions in force."""

    name = "adaptation"
    inputs = ()
    outputs = (LATENT,)
    share = 0.0

    def __init__(self, model: PhysicsModel, settings: EstimatorSettings | None = None) -> None:
        self._model = model
        self._settings = settings or EstimatorSettings()
        self._fingerprint = fingerprint(model)
        self._robots: dict[str, _Memory] = {}

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        del inputs
        values = np.array(state.values)
        memory = self._robots.get(robot)
        if memory is None:
            memory = self._robots[robot] = _Memory(LatentEstimator(self._model, self._settings), state.tick, values)
        elif state.tick == memory.tick + 1:
            memory.estimator.update(memory.state, np.array(state.applied), values, state.period)
        else:
            memory.estimator.forget_actuators()
        memory.tick, memory.state = state.tick, values
        return {LATENT: self._message(state, memory.estimator)}

    def forget(self, robot: str) -> None:  # noqa: D102
        self._robots.pop(robot, None)

    def _message(self, state: StateMessage, estimator: LatentEstimator) -> LatentMessage:
        return LatentMessage(
            epoch=state.epoch,
            tick=state.tick,
            robot_time=state.robot_time,
            publish_time=time.time(),
            model=self._fingerprint,
            values=tuple(float(value) for value in estimator.latent),
            deviations=tuple(float(value) for value in estimator.deviations),
        )
