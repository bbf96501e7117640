"""What a pendulum's policy learns: to get upright the long way round, in winds that it does not know."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from safedpa.networks import Weights
from safedpa.policy.learned import LearnedPolicy
from safedpa_sim.pendulum.kept import kept_drives
from safedpa_sim.pendulum.swinging import EPISODE_TICKS, Swinging
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.drives import random_drives as random_drives_around
from safedpa_sim.training.histories import Lived, joined
from safedpa_sim.training.networks import AffineNetworks
from safedpa_sim.training.simulator import BatchedCars

__all__ = ["evaluate", "practice", "random_drives"]

_EVALUATION_SEED = 1_000_003
"""Added to the configuration's seed: no swing of the evaluation is trained on."""


def practice(
    configuration: Configuration, weights: Weights, count: int, seed: int, penalty: float, sheltered: bool
) -> Swinging:
    """Pendulums to train on; ``penalty`` is for entering the hazard, ``sheltered`` by a stand-in for the filter."""
    return Swinging(configuration, weights, count, seed, sheltered=sheltered, penalty=penalty)


def random_drives(
    cars: BatchedCars,
    networks: AffineNetworks,
    count: int,
    steps: int,
    change: float,
    generator: torch.Generator,
) -> Lived:
    """Half the pendulums swing all around, half are kept within 45 degrees by an exact stand-in for the filter."""
    around = random_drives_around(cars, networks, count - count // 2, steps, change, generator)
    if count < 2:
        return around
    return joined([around, kept_drives(cars, networks, count // 2, steps, change, generator)])


def evaluate(
    configuration: Configuration, weights: Weights, *, cars: int = 512, seed: int = 0, sheltered: bool = True
) -> dict[str, Any]:
    """One swing of each pendulum under the policy without noise: the share upright at its end, and hazards entered."""
    swings = Swinging(configuration, weights, cars, seed + _EVALUATION_SEED, sheltered=sheltered, calm=True)
    policy = LearnedPolicy(weights)
    middle, scale = weights["action_middle"], weights["action_scale"]
    gained, contacts = np.zeros(cars), np.zeros(cars)
    nearest = np.full(cars, np.inf)
    for _ in range(EPISODE_TICKS):
        chosen = (policy.act(swings.observation()) - middle) / scale
        moved = swings.advance(chosen.astype(np.float32))
        gained += moved.reward
        contacts += moved.began
        nearest = np.minimum(nearest, np.abs(np.sin(0.5 * swings.state[:, 0])))
    return {
        "success": float(moved.reached.mean()),
        "contacts": float(contacts.mean()),
        "nearest": float(nearest.mean()),
        "reward": float(gained.mean()),
    }
