"""The interface of the task that a policy is trained on, the result of a period, and the registry of tasks by robot."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any, Final, Protocol, final

import numpy as np
import torch
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, Float32Array
from safedpa.errors import InputError, did_you_mean
from safedpa.networks import Weights
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.data.transitions import TransitionSequence
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.networks.modules import AffineNetworks

EVALUATION_SEED: Final = 1_000_003
"""Added to the configuration's seed, so that no evaluation episode is trained on."""


@final
@dataclass(frozen=True)
class PeriodResult:
    """Arrays (robots,) of one period; an episode ends when it has ``reached`` its goal or has ``timed_out``."""

    reward: Float32Array
    reached: BoolArray
    timed_out: BoolArray
    contact: BoolArray
    """Whether the robot violates its constraint: it touches something or is in a hazard."""
    began: BoolArray
    """Whether the contact began in this tick."""


class BatchedEnvironment(Protocol):
    """A batch of robots in episodes with a reward; the same seed gives the same episodes."""

    count: int

    def restart(self, which: NDArray[np.intp]) -> None:
        """Starts new episodes for the robots with the given indices."""

    def observation(self, which: NDArray[np.intp] | slice = ...) -> Float32Array:
        """Returns the observations (count, observations) of the robots with the given indices, by default of all."""

    def exploring(self, random: np.random.Generator) -> Float32Array:
        """Returns random actions (count, actions) in [-1, 1], by which the observations are scaled."""

    def advance(self, chosen: Float32Array) -> PeriodResult:
        """Simulates one period under ``chosen`` (count, actions), each entry in [-1, 1] over the range of commands."""


class PolicyTask(Protocol):
    """The policy task of one kind of robot; implemented by modules."""

    def make_environment(
        self,
        configuration: Configuration,
        weights: Weights,
        count: int,
        seed: int,
        *,
        penalty: float = 0.0,
        with_filter: bool = True,
    ) -> BatchedEnvironment:
        """Returns ``count`` robots to train on.

        The beginning of a contact costs ``penalty``; ``with_filter``, a safety filter corrects each action.
        """

    def evaluate(
        self, configuration: Configuration, weights: Weights, *, cars: int, seed: int, with_filter: bool
    ) -> dict[str, Any]:
        """Evaluates one noise-free episode of ``cars`` robots: ``success``, ``contacts``, ``nearest``, ``reward``."""

    def random_drives(
        self,
        cars: BatchedSimulator,
        networks: AffineNetworks,
        count: int,
        steps: int,
        change: float,
        generator: torch.Generator,
    ) -> TransitionSequence:
        """Simulates ``count`` robots under random actions; ``change``: of the environment, probability per period."""


TASKS: Final = {
    "car": "safedpa_sim.training.environments.car_task",
    "pendulum": "safedpa_sim.pendulum.policy_task",
    "point": "safedpa_sim.point.policy_task",
}


def task_of(robot: str) -> PolicyTask:
    """Returns the policy task of a kind of robot. Raises InputError when it has none."""
    if robot not in TASKS:
        raise InputError(f"phase 1b: robot '{robot}': {did_you_mean(robot, TASKS)}")
    found: Any = importlib.import_module(TASKS[robot])
    task: PolicyTask = found
    return task
