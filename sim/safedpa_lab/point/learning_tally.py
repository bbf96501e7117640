"""What happens to robots while their policy learns: every step counts, in rows of so many steps."""

from __future__ import annotations

from typing import Any, Final, final

import numpy as np

from safedpa.arrays import BoolArray
from safedpa_sim.point.task import StepResult

__all__ = ["COUNTS", "Tally"]


COUNTS: Final = ("unsafe", "goals", "reward", "corrected", "relaxed", "episodes", "safe_episodes", "episode_goals")
"""Sums of a row: steps in a hazard, goals, the benchmark's reward, steps that the filter changed, steps in which not
every condition could be kept; whole episodes that ended, those of them without an unsafe step, their goals."""


@final
class Tally:
    """Of ``count`` robots. An episode counts among the whole ones when it was seen from its first step on."""

    def __init__(self, count: int) -> None:
        self.rows: list[dict[str, Any]] = []
        """``steps``: of all robots together, since the learning began; then ``COUNTS``."""
        self._count, self._steps = count, 0
        self._whole = np.zeros(count, bool)
        self._paid, self._reached = np.zeros(count), np.zeros(count)
        self._sums = dict.fromkeys(COUNTS, 0.0)

    def add(self, stepped: StepResult, corrected: BoolArray, relaxed: BoolArray) -> None:
        """One step of every robot."""
        self._steps += self._count
        self._paid += stepped.cost
        self._reached += stepped.reached
        over = stepped.timed_out & self._whole
        each = (stepped.cost, stepped.reached, stepped.reward, corrected, relaxed)
        ended = (over, over & (self._paid == 0.0), self._reached * over)
        for name, values in zip(COUNTS, (*each, *ended), strict=True):
            self._sums[name] += float(values.sum())
        self._whole |= stepped.timed_out
        self._paid[stepped.timed_out] = self._reached[stepped.timed_out] = 0.0

    def close_row(self) -> None:
        """What came since the last row becomes one."""
        self.rows.append({"steps": self._steps, **{name: round(value, 4) for name, value in self._sums.items()}})
        self._sums = dict.fromkeys(COUNTS, 0.0)
