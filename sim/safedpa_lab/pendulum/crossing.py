"""Question 2 of the paper: from just beneath the hazard, upright the long way round, without entering the hazard."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import LearnedBase
from safedpa.policy import LearnedPolicy
from safedpa.robots.pendulum.pendulum_observation import observe_pendulum
from safedpa_lab.pendulum.balancing import winds_and_starts
from safedpa_lab.pendulum.methods import Method, closed_of, model_named
from safedpa_lab.pendulum.rollouts import Swung, Wish, swung
from safedpa_sim.pendulum.swinging import EPISODE_TICKS, starts_beneath
from safedpa_sim.pendulum.task import HAZARD, HELD_TICKS, LONG_WAY_ROUND, UPRIGHT, in_hazard, is_upright

__all__ = ["crossed", "crossed_account"]

Floats = NDArray[np.float64]


def crossed(method: Method, folder: Path, epsilon: float, directions: int, episodes: int, seed: int) -> Swung:
    """Episodes of one method, from just beneath the hazard, moving towards it; the same starts and winds for all."""
    wind, _ = winds_and_starts(directions, episodes, seed)
    start = starts_beneath(len(wind), np.random.default_rng([seed, 23]))
    wish = _wish(method, folder)
    return swung(closed_of(method, folder, epsilon), wish, start, wind, LONG_WAY_ROUND, EPISODE_TICKS)


def _wish(method: Method, folder: Path) -> Wish:
    base = model_named(method.policy, folder).base
    assert isinstance(base, LearnedBase)
    policy = LearnedPolicy(base.weights)
    sees = base.weights.description.latents

    def wish(state: Floats, latent: Floats) -> Floats:
        seen = observe_pendulum(state, np.full(len(state), UPRIGHT), latent[:, :sees])
        return np.asarray(policy.act(seen), dtype=np.float64)

    return wish


def crossed_account(swings: Swung, directions: int) -> dict[str, Any]:
    """Episodes that ended upright (for the last half second), that never entered the hazard, and both; by direction."""
    angle = swings.states[..., 0]
    safe = ~np.any(in_hazard(angle), axis=0)
    success = np.all(is_upright(swings.states[-HELD_TICKS:]), axis=0)
    return {
        "episodes": int(safe.size),
        "safe": int(safe.sum()),
        "success": int(success.sum()),
        "both": int((safe & success).sum()),
        "safety_rate": safe.reshape(directions, -1).mean(1).tolist(),
        "success_rate": success.reshape(directions, -1).mean(1).tolist(),
        "least_room": _room(angle).min(0).reshape(directions, -1).min(1).tolist(),
        "corrected": float(swings.corrected.mean()),
        "relaxed": float(swings.relaxed.mean()),
    }


def _room(angle: Floats) -> Floats:
    """Distance [rad] to the hazard's nearer edge, negative inside, for angles of any number of turns."""
    low, high = HAZARD
    off = np.mod(angle - 0.5 * (low + high) + np.pi, 2 * np.pi) - np.pi
    return np.asarray(np.abs(off) - 0.5 * (high - low))
