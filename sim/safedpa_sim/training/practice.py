"""What a policy is trained on, for each kind of robot: many of them at a time, with a reward, and an evaluation."""

from __future__ import annotations

import importlib
from typing import Any, Final, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from safedpa.arrays import Float32Array
from safedpa.errors import InputError, did_you_mean
from safedpa.networks import Weights
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.histories import TransitionSequence
from safedpa_sim.training.networks import AffineNetworks
from safedpa_sim.training.one_period import PeriodResult
from safedpa_sim.training.simulator import BatchedCars

__all__ = ["PolicyTask", "Practice", "has_task", "task_of"]


class Practice(Protocol):
    """Many robots that practise; the same seed gives the same episodes."""

    count: int

    def restart(self, which: NDArray[np.intp]) -> None:
        """New episodes for the robots of those indices."""

    def observation(self, which: NDArray[np.intp] | slice = ...) -> Float32Array:
        """What the policy sees of the robots of those indices, all of them without (count, observations)."""

    def exploring(self, random: np.random.Generator) -> Float32Array:
        """Actions at random (count, actions) in [-1, 1], for the scales of what is observed."""

    def advance(self, chosen: Float32Array) -> PeriodResult:
        """One period under ``chosen`` (count, actions), each entry in [-1, 1] over the range of commands."""


class PolicyTask(Protocol):
    """What policies of one kind of robot learn. Modules fulfil it."""

    def practice(
        self, configuration: Configuration, weights: Weights, count: int, seed: int, penalty: float, sheltered: bool
    ) -> Practice:
        """Robots to train on; ``penalty`` is taken off when a contact begins, ``sheltered`` as if by the filter."""

    def evaluate(
        self, configuration: Configuration, weights: Weights, *, cars: int, seed: int, sheltered: bool
    ) -> dict[str, Any]:
        """``success``, ``contacts``, ``nearest`` and ``reward`` of one episode of each of ``cars`` robots, no noise."""

    def random_drives(
        self,
        cars: BatchedCars,
        networks: AffineNetworks,
        count: int,
        steps: int,
        change: float,
        generator: torch.Generator,
    ) -> TransitionSequence:
        """Histories of ``count`` robots under actions at random; environments change with probability ``change``."""


_TASKS: Final = {
    "car": "safedpa_sim.training.car_task",
    "pendulum": "safedpa_sim.pendulum.policy_task",
    "point": "safedpa_sim.point.policy_task",
}


def has_task(robot: str) -> bool:
    """Whether a policy of that kind of robot can be trained."""
    return robot in _TASKS


def task_of(robot: str) -> PolicyTask:
    """The task of a kind of robot. Raises InputError when none is known."""
    if robot not in _TASKS:
        raise InputError(f"phase 1b: robot '{robot}': {did_you_mean(robot, _TASKS)}")
    found: Any = importlib.import_module(_TASKS[robot])
    task: PolicyTask = found
    return task
