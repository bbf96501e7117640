"""Question 1 of the paper: random actions through the filter. Does the pendulum stay within 45 degrees in any wind?"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_lab.pendulum.difficulty import Episodes
from safedpa_lab.pendulum.methods import Method, closed_of
from safedpa_lab.pendulum.rollouts import Swung, swung

__all__ = ["balanced", "balanced_account", "sensors_of"]

TICKS = 300
"""3 s."""


def sensors_of(episodes: Episodes) -> Callable[[FloatArray], FloatArray]:
    """What reports states (n, 2) with the noise of the difficulty, the same for every method."""
    deviation, random = episodes.difficulty.noise, episodes.random(27)
    if not deviation:
        return np.array
    return lambda state: state + random.normal(0.0, deviation, state.shape)


def balanced(method: Method, folder: Path, epsilon: float, episodes: Episodes, ticks: int = TICKS) -> Swung:
    """Episodes of one method, every torque drawn uniformly over the bounds; the same draws for every method."""
    difficulty, random = episodes.difficulty, episodes.random(22)

    def nominal_action(state: FloatArray, _latent: FloatArray) -> FloatArray:
        return random.uniform(-difficulty.torque, difficulty.torque, (len(state), 1))

    closed, sensed = closed_of(method, folder, epsilon, difficulty), sensors_of(episodes)
    return swung(
        closed, nominal_action, episodes.upright_starts(), episodes.winds(), difficulty.balancing, ticks, sensed
    )


def balanced_account(swings: Swung, episodes: Episodes) -> dict[str, Any]:
    """Which episodes were without violation; per direction the least room left [rad]; shares of corrected ticks."""
    room = episodes.difficulty.corridor - np.abs(swings.states[..., 0]).max(0)
    by_direction = room.reshape(episodes.directions, -1)
    return {
        "episodes": int(room.size),
        "safe": int((room >= 0.0).sum()),
        "safe_each": (room >= 0.0).astype(int).tolist(),
        "safety_rate": (by_direction >= 0.0).mean(1).tolist(),
        "least_room": by_direction.min(1).tolist(),
        "corrected": float(swings.corrected.mean()),
        "relaxed": float(swings.relaxed.mean()),
    }
