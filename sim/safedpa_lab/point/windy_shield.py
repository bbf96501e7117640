"""A method's filter before robots that learn, each of their episodes in a wind of the evaluation's kind."""

from __future__ import annotations

from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa_lab.point.shield import Shield
from safedpa_sim.point.task import PointTask

__all__ = ["DIRECTIONS", "WindyShield"]

DIRECTIONS: Final = 24
"""Of the wind, evenly around."""


@final
class WindyShield:
    """What is carried out is the shield's; at each beginning the wind has ``force`` [N] towards one of the directions.

    Winds are drawn from ``seed`` in the order of the beginnings: anyone who begins at the same steps meets the same.
    """

    def __init__(self, task: PointTask, shield: Shield, force: float, seed: int) -> None:
        self._task, self._shield, self._force = task, shield, force
        self._random = np.random.default_rng([seed, 71])
        self.corrected = self.relaxed = np.zeros(task.count, bool)
        """(robots,): where the last action is not the nominal action; where not every condition could be kept."""
        self._blow(np.arange(task.count))

    def safe(self, chosen: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Actions (robots, 2) of ``PointTask`` for those that were chosen, to be carried out at once."""
        found = self._shield.act(self._task, chosen)
        self.corrected, self.relaxed = found.corrected, found.relaxed
        return found.action

    def restart(self, which: NDArray[np.intp]) -> None:
        """New layouts and winds for the robots of those indices; the filter forgets what it knew of the old ones."""
        self._task.restart(which)
        self._blow(which)
        self._shield.reset(which)

    def _blow(self, which: NDArray[np.intp]) -> None:
        towards = 2.0 * np.pi / DIRECTIONS * self._random.integers(0, DIRECTIONS, len(which))
        self._task.simulation.force[:, which] = self._force * np.stack((np.cos(towards), np.sin(towards)))
