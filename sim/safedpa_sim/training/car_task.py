"""What a car's policy learns: to drive to goals among obstacles, with loads and wind that it does not know."""

from __future__ import annotations

from typing import Any

import numpy as np

from safedpa.networks import Weights
from safedpa.policy.learned import LearnedPolicy
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.drives import random_drives
from safedpa_sim.training.driving import EPISODE_TICKS, Driving, Rewards
from safedpa_sim.training.scenes import FOOTPRINTS

__all__ = ["evaluate", "practice", "random_drives"]

_EVALUATION_SEED = 1_000_003
"""Added to the configuration's seed: no scene of the evaluation is trained on."""


def practice(
    configuration: Configuration, weights: Weights, count: int, seed: int, penalty: float, sheltered: bool
) -> Driving:
    """Cars to train on; ``penalty`` is for contacts, ``sheltered`` by a stand-in for the filter."""
    rewards = Rewards(penalty=penalty)
    return Driving(configuration, weights, count, seed, rewards=rewards, sheltered=sheltered)


def evaluate(
    configuration: Configuration, weights: Weights, *, cars: int = 512, seed: int = 0, sheltered: bool = True
) -> dict[str, Any]:
    """One drive of each car under the policy without noise: the share that reach the goal within 15 s, and contacts.

    ``success_by_radius`` tells the same for the footprint of the car alone and of each load, by the nearest radius [m].
    """
    driving = Driving(configuration, weights, cars, seed + _EVALUATION_SEED, sheltered=sheltered, calm=True)
    policy = LearnedPolicy(weights)
    middle, scale = weights["action_middle"], weights["action_scale"]
    reached, contacts = np.zeros(cars, dtype=bool), np.zeros(cars, dtype=np.int64)
    ticks, gained = np.full(cars, EPISODE_TICKS), np.zeros(cars)
    nearest = driving.distance.copy()
    for tick in range(EPISODE_TICKS):
        chosen = (policy.act(driving.observation()) - middle) / scale
        moved = driving.advance(chosen.astype(np.float32))
        ticks[moved.reached & ~reached] = tick + 1
        contacts += moved.began & ~reached
        gained += np.where(reached, 0.0, moved.reward)
        nearest = np.minimum(nearest, driving.distance)
        reached |= moved.reached
    radii = np.array([item[2] for item in FOOTPRINTS])
    group = np.abs(driving.scene.footprint[:, 2, np.newaxis] - radii).argmin(axis=1)
    return {
        "success": float(reached.mean()),
        "contacts": float(contacts.mean()),
        "nearest": float(nearest.mean()),
        "reward": float(gained.mean()),
        "mean_seconds": float(ticks.mean() * driving.period),
        "success_by_radius": {
            f"{radius:.2f}": float(reached[group == index].mean())
            for index, radius in enumerate(radii)
            if (group == index).any()
        },
    }
