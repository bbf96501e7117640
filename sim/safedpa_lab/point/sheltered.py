"""What stands between a policy that learns and the robots; here the filter that knows the simulated physics."""

from __future__ import annotations

from typing import Any, Protocol, final

import numpy as np
from numpy.typing import NDArray

from safedpa_lab.point.beliefs import from_task_action
from safedpa_sim.point.body_steps import centre_state
from safedpa_sim.point.filtering import PointFilter
from safedpa_sim.point.point_model import SimulatedPointModel, to_task_action
from safedpa_sim.point.policy_task import EPSILON
from safedpa_sim.point.task import PointTask

__all__ = ["Shelter", "Sheltering"]


class Sheltering(Protocol):
    """For all robots of a task: what is carried out of what was chosen, and how episodes begin."""

    def safe(self, chosen: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Actions (robots, 2) of ``PointTask`` for those that were chosen."""

    def restart(self, which: NDArray[np.intp]) -> None:
        """New episodes for the robots of those indices."""


@final
class Shelter:
    """By the truth: a stand-in of SafeDPA's filter in training."""

    def __init__(self, task: PointTask) -> None:
        self._task, self._belief, self._filter = task, SimulatedPointModel(task.simulation), PointFilter(EPSILON)

    def safe(self, chosen: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Safe actions (robots, 2) of ``PointTask`` for those that were chosen."""
        task = self._task
        state = centre_state(task.simulation)
        believed = self._belief.predict(state, np.zeros((task.count, 0)))
        nominal = from_task_action(np.asarray(chosen, dtype=np.float64))
        return to_task_action(self._filter.decide(state, nominal, task.layout.hazards, believed).action)

    def restart(self, which: NDArray[np.intp]) -> None:
        """New episodes as the task draws them; nothing is remembered here."""
        self._task.restart(which)
