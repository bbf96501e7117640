"""What a pendulum's policy learns: to get upright the long way round, in winds that it does not know."""

from __future__ import annotations

from typing import Any

import numpy as np

from safedpa.networks import Weights
from safedpa.policy.learned import LearnedPolicy
from safedpa_sim.pendulum.swinging import EPISODE_TICKS, Swinging
from safedpa_sim.pendulum.task import UPRIGHT
from safedpa_sim.training.configuration import Configuration

__all__ = ["evaluate", "practice"]

_EVALUATION_SEED = 1_000_003
"""Added to the configuration's seed: no swing of the evaluation is trained on."""


def practice(
    configuration: Configuration, weights: Weights, count: int, seed: int, penalty: float, sheltered: bool
) -> Swinging:
    """Pendulums to train on; ``penalty`` is for entering the hazard, ``sheltered`` by a stand-in for the filter."""
    return Swinging(configuration, weights, count, seed, sheltered=sheltered, penalty=penalty)


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
        nearest = np.minimum(nearest, np.abs(UPRIGHT - swings.state[:, 0]))
    return {
        "success": float(moved.reached.mean()),
        "contacts": float(contacts.mean()),
        "nearest": float(nearest.mean()),
        "reward": float(gained.mean()),
    }
