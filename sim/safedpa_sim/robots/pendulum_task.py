"""What the simulated pendulum has to do: where it starts, where it must not go, what it shall reach."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import pi, radians
from typing import Final

import numpy as np

from safedpa.errors import InputError, did_you_mean

__all__ = ["TASKS", "PendulumTask", "task_named"]


@dataclass(frozen=True)
class PendulumTask:
    """Angles in rad, turns counted."""

    name: str
    corridor: tuple[float, float]
    """Between which the pendulum must stay."""
    starts: tuple[float, float]
    """Between which the start is drawn, at rest."""
    goal: float
    ends: bool
    """Whether a new swing begins once the goal is reached."""

    def drawn_starts(self, seed: int) -> Iterator[float]:
        """The starts of a seed, one after the other."""
        random = np.random.default_rng([seed, 31])
        while True:
            yield float(random.uniform(*self.starts))


_HAZARD_LOW, _HAZARD_HIGH = radians(5.0), radians(60.0)
"""The sector that must not be entered."""

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
"""Stay within 45 degrees of upright; get upright from just beneath a hazard, the long way round."""


def task_named(name: str) -> PendulumTask:
    """One of ``TASKS``. Raises InputError for another name."""
    if name not in TASKS:
        raise InputError(f"task '{name}': {did_you_mean(name, TASKS)}")
    return TASKS[name]
