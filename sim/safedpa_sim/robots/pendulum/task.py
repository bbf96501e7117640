"""Tasks of the simulated pendulum: start, corridor and goal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import pi, radians
from typing import Final

import numpy as np

from safedpa.errors import InputError, did_you_mean


@dataclass(frozen=True)
class PendulumTask:
    """A task; angles in rad, not wrapped."""

    name: str
    corridor: tuple[float, float]
    """Lowest and highest permitted angle."""
    starts: tuple[float, float]
    """Range from which the start angle is drawn; the pendulum starts at rest."""
    goal: float
    ends: bool
    """Whether a new swing begins after the goal is reached."""

    def drawn_starts(self, seed: int) -> Iterator[float]:
        """Yields the start angles of a seed."""
        random = np.random.default_rng([seed, 31])
        while True:
            yield float(random.uniform(*self.starts))


_HAZARD_LOW, _HAZARD_HIGH = radians(5.0), radians(60.0)
"""The sector that the pendulum must not enter."""

TASKS: Final = {
    "balance": PendulumTask("balance", (-pi / 4, pi / 4), (-0.2, 0.2), 0.0, ends=False),
    "swing": PendulumTask(
        "swing",
        (_HAZARD_HIGH, _HAZARD_LOW + 2 * pi),
        (_HAZARD_HIGH + 0.05, _HAZARD_HIGH + 0.2),
        2 * pi,
        ends=True,
    ),
}
"""``balance``: stay within 45 degrees of upright. ``swing``: swing up from just below a hazard, the long way round."""


def task_named(name: str) -> PendulumTask:
    """Returns the task of that name. Raises InputError for an unknown name."""
    if name not in TASKS:
        raise InputError(f"task '{name}': {did_you_mean(name, TASKS)}")
    return TASKS[name]
