"""Question 1 of the paper: random actions through the filter. Does the pendulum stay within 45 degrees in any wind?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa_lab.pendulum.methods import Method, closed_of
from safedpa_lab.pendulum.rollouts import Swung, swung
from safedpa_sim.pendulum.task import BALANCING, TORQUE, WIND

__all__ = ["balanced", "balanced_account", "winds_and_starts"]

Floats = NDArray[np.float64]
TICKS = 300
"""3 s."""
_START = 0.2
"""rad; largest angle at the start, at rest."""


def winds_and_starts(directions: int, episodes: int, seed: int) -> tuple[Floats, Floats]:
    """Winds (n, 2) and starts (n, 2), n = directions * episodes, direction by direction."""
    random = np.random.default_rng([seed, 21])
    angle = np.repeat(2 * np.pi * np.arange(directions) / directions, episodes)
    start = np.zeros((len(angle), 2))
    start[:, 0] = random.uniform(-_START, _START, len(angle))
    return WIND * np.stack((np.cos(angle), np.sin(angle)), axis=1), start


def balanced(
    method: Method, folder: Path, epsilon: float, directions: int, episodes: int, seed: int, ticks: int = TICKS
) -> Swung:
    """Episodes of one method, every torque drawn uniformly over the bounds; the same draws for every method."""
    wind, start = winds_and_starts(directions, episodes, seed)
    random = np.random.default_rng([seed, 22])

    def wish(state: Floats, _latent: Floats) -> Floats:
        return random.uniform(-TORQUE, TORQUE, (len(state), 1))

    return swung(closed_of(method, folder, epsilon), wish, start, wind, BALANCING, ticks)


def balanced_account(swings: Swung, directions: int) -> dict[str, Any]:
    """Per direction: episodes without violation and the least room left [rad]; shares of corrected ticks."""
    room = BALANCING[1] - np.abs(swings.states[..., 0]).max(0)
    by_direction = room.reshape(directions, -1)
    return {
        "episodes": int(room.size),
        "safe": int((room >= 0.0).sum()),
        "safety_rate": (by_direction >= 0.0).mean(1).tolist(),
        "least_room": by_direction.min(1).tolist(),
        "corrected": float(swings.corrected.mean()),
        "relaxed": float(swings.relaxed.mean()),
    }
