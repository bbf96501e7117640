"""The safety filter of one method before all robots of a task, with the histories and latents that belong to it."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Protocol, final

import numpy as np
from numpy.typing import NDArray

from safedpa.adaptation.batch_history_estimator import BatchHistoryEstimator
from safedpa.arrays import FloatArray
from safedpa.errors import InputError, did_you_mean
from safedpa_lab.point.beliefs import LearnedBelief, from_task_action
from safedpa_lab.point.sensed_belief import SensedBelief, TwoHistories, sensed_weights
from safedpa_lab.point.weights import weights_named
from safedpa_sim.point.body_steps import centre_state
from safedpa_sim.point.filtering import FilteredActions, PointFilter
from safedpa_sim.point.point_model import (
    ACTION_SCALE,
    AbstractPointModel,
    PointPrediction,
    SimulatedPointModel,
    to_task_action,
)
from safedpa_sim.point.task import PointTask

__all__ = ["EPSILON", "FIXED_DIRECTIONS", "METHODS", "Adaptation", "Shield", "shield_of"]


EPSILON: Final = 0.005
"""m; where no one measured one: of a diagnosed model, and while moments are drawn behind the truth."""
FIXED_DIRECTIONS: Final = (45, 135, 225, 315)
METHODS: Final = (
    "safedpa",
    "safedpa_17",
    *(f"fix_{direction}" for direction in FIXED_DIRECTIONS),
    "mix",
    "oracle",
    "physics",
    "none",
)
"""Whose model the filter believes: learned with the latent; learned of what is sensed; of one force alone; of all at
once; the truth; the truth but for the wind; no filter."""


class Adaptation(Protocol):
    """What ``BatchHistoryEstimator`` does."""

    @property
    def latent(self) -> FloatArray:
        """Of the states that were seen last."""

    def see(self, state: FloatArray) -> FloatArray:
        """The latents at states (robots, 5)."""

    def acted(self, action: FloatArray) -> None:
        """Actions (robots, 2) in N and rad/s act from now on."""

    def reset(self, which: NDArray[np.intp]) -> None:
        """The robots of those indices begin again."""


@final
class Shield:
    """Each period ``see`` the robots, then ``act``; ``reset`` those that begin a new episode.

    ``belief`` nothing: nominal actions pass as they are. ``adaptation`` nothing: latents of no entries.
    """

    def __init__(
        self, count: int, belief: AbstractPointModel | None, adaptation: Adaptation | None, epsilon: float = EPSILON
    ) -> None:
        self._belief, self._adaptation, self._filter = belief, adaptation, PointFilter(epsilon)
        self._nothing = np.zeros((count, 0))
        self._state: FloatArray | None = None
        self._believed: PointPrediction | None = None

    def reset(self, which: NDArray[np.intp]) -> None:
        """The robots of those indices have been put elsewhere: forget their histories."""
        if self._adaptation is not None:
            self._adaptation.reset(which)
        self._state = self._believed = None

    def see(self, task: PointTask) -> FloatArray:
        """The latents (robots, latents) of the robots as they are; twice in a period changes nothing."""
        if self._state is None:
            self._state = centre_state(task.simulation)
            if self._adaptation is not None:
                self._adaptation.see(self._state)
        return self.latent

    @property
    def latent(self) -> FloatArray:
        """What was seen last."""
        return self._nothing if self._adaptation is None else self._adaptation.latent

    def believes(self, task: PointTask) -> PointPrediction:
        """What the filter's model says of the robots as they are. Raises InputError where there is no filter."""
        if self._belief is None:
            raise InputError("shield: got no filter, wanted one whose model can be asked")
        self.see(task)
        if self._believed is None:
            state = centre_state(task.simulation) if self._state is None else self._state
            self._believed = self._belief.predict(state, self.latent)
        return self._believed

    def act(self, task: PointTask, nominal: NDArray[np.floating]) -> FilteredActions:
        """Safe actions of ``PointTask`` for nominal actions (robots, 2) of it, to be carried out at once."""
        self.see(task)
        scaled = from_task_action(np.asarray(nominal, dtype=np.float64))
        chosen = self._safe(task, scaled)
        self.acted(chosen.action)
        return FilteredActions(to_task_action(chosen.action), chosen.corrected, chosen.relaxed)

    def acted(self, action: FloatArray) -> None:
        """Actions (robots, 2) in [-1, 1] over the range of commands are being carried out."""
        if self._adaptation is not None:
            self._adaptation.acted(action * ACTION_SCALE)
        self._state = self._believed = None

    def _safe(self, task: PointTask, nominal: FloatArray) -> FilteredActions:
        if self._belief is None:
            unchanged = np.zeros(len(nominal), bool)
            return FilteredActions(nominal, unchanged, unchanged)
        state = centre_state(task.simulation) if self._state is None else self._state
        return self._filter.decide(state, nominal, task.layout.hazards, self.believes(task))


def shield_of(
    method: str, task: PointTask, *, adapts: str = "learned", epsilon: float = EPSILON, folder: Path = Path()
) -> Shield:
    """The filter of one of ``METHODS`` for the robots of a task.

    ``adapts`` names the weights whose phi gives the latents, for the filter of SafeDPA and for any policy; nothing: no
    latents. Raises InputError for a method or a model that there is none of.
    """
    if method not in METHODS:
        raise InputError(f"method '{method}': {did_you_mean(method, METHODS)}")
    adaptation = BatchHistoryEstimator(weights_named(adapts, folder), task.count) if adapts else None
    if method in ("safedpa", "safedpa_17") and adaptation is None:
        raise InputError(f"method '{method}': got no model to adapt with, wanted adapts='learned' or another with phi")
    if method == "safedpa_17" and adaptation is not None:
        return _sensed(adaptation, task, epsilon, folder)
    return Shield(task.count, _belief(method, adapts, task, folder), adaptation, epsilon)


def _sensed(policy: BatchHistoryEstimator, task: PointTask, epsilon: float, folder: Path) -> Shield:
    weights = sensed_weights(folder)
    histories = TwoHistories(policy, weights, task)
    return Shield(task.count, SensedBelief(weights, histories, task), histories, epsilon)


def _belief(method: str, adapts: str, task: PointTask, folder: Path) -> AbstractPointModel | None:
    if method == "none":
        return None
    if method in ("oracle", "physics"):
        return SimulatedPointModel(task.simulation, wind=method == "oracle")
    return LearnedBelief(weights_named(adapts if method == "safedpa" else method, folder))
