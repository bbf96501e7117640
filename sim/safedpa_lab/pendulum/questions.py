"""The paper's two questions about the pendulum, episodes of each under one method.

``balanced``: random actions through the filter; does the pendulum stay within 45 degrees in any wind? ``crossed``: from
just beneath the hazard, upright the long way round, without entering the hazard.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import LearnedBase
from safedpa.policy import LearnedPolicy
from safedpa.robots.pendulum.perception import observe_pendulum
from safedpa_lab.pendulum.difficulty import Difficulty, Episodes
from safedpa_lab.pendulum.methods import Method, closed_of, model_named
from safedpa_lab.pendulum.rollouts import NominalPolicy, Swung, swung
from safedpa_sim.pendulum.policy_task import EPISODE_TICKS
from safedpa_sim.pendulum.task import HAZARD, HELD_TICKS, TORQUE, UPRIGHT, is_upright

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


_PULL, _DAMPING = 100.0, 9.0
"""N m/rad and N m s/rad of the goal seeker: a wind of 4 m/s moves it by 2 degrees; chosen on development seed 5."""


def crossed(method: Method, folder: Path, epsilon: float, episodes: Episodes) -> Swung:
    """Episodes of one method, from just beneath the hazard, moving towards it; the same starts and winds for all."""
    difficulty, winds = episodes.difficulty, episodes.winds()
    closed, sensed = closed_of(method, folder, epsilon, difficulty), sensors_of(episodes)
    nominal, edges = _nominal_action(method, folder, winds), difficulty.long_way_round
    return swung(closed, nominal, episodes.starts_beneath(), winds, edges, EPISODE_TICKS, sensed)


def _nominal_action(method: Method, folder: Path, winds: FloatArray) -> NominalPolicy:
    if method.policy == "goal_seeker":
        return _seeking
    base = model_named(method.policy, folder).base
    assert isinstance(base, LearnedBase)
    policy = LearnedPolicy(base.weights)
    sees = base.weights.description.latents
    reported = base.networks.encode(winds) if method.reported else None

    def nominal_action(state: FloatArray, latent: FloatArray) -> FloatArray:
        known = latent if reported is None else reported
        seen = observe_pendulum(state, np.full(len(state), UPRIGHT), known[:, :sees])
        return np.asarray(policy.act(seen), dtype=np.float64)

    return nominal_action


def _seeking(state: FloatArray, _latent: FloatArray) -> FloatArray:
    """Torque [N m] (n, 1) of a spring to upright, the long way round, and a damper: no learning, no wind."""
    return np.clip(_PULL * (UPRIGHT - state[:, :1]) - _DAMPING * state[:, 1:], -TORQUE, TORQUE)


def crossed_account(swings: Swung, episodes: Episodes) -> dict[str, Any]:
    """Which episodes ended upright (for the last half second), which never entered the hazard, and both."""
    angle, rows = swings.states[..., 0], episodes.directions
    safe = ~np.any(episodes.difficulty.in_hazard(angle), axis=0)
    success = np.all(is_upright(swings.states[-HELD_TICKS:]), axis=0)
    return {
        "episodes": int(safe.size),
        "safe": int(safe.sum()),
        "success": int(success.sum()),
        "both": int((safe & success).sum()),
        "safe_each": safe.astype(int).tolist(),
        "success_each": success.astype(int).tolist(),
        "safety_rate": safe.reshape(rows, -1).mean(1).tolist(),
        "success_rate": success.reshape(rows, -1).mean(1).tolist(),
        "least_room": _room(angle, episodes.difficulty).min(0).reshape(rows, -1).min(1).tolist(),
        "corrected": float(swings.corrected.mean()),
        "relaxed": float(swings.relaxed.mean()),
    }


def _room(angle: FloatArray, difficulty: Difficulty) -> FloatArray:
    """Distance [rad] to the hazard's nearer edge, negative inside, for angles of any number of turns."""
    low, high = difficulty.hazard, HAZARD[1]
    off = np.mod(angle - 0.5 * (low + high) + np.pi, 2 * np.pi) - np.pi
    return np.asarray(np.abs(off) - 0.5 * (high - low))
