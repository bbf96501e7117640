"""The margin of the pendulum's filters, from one-step errors on swings that no network was trained on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import fingerprint
from safedpa.safety import split_conformal_margin
from safedpa_lab.pendulum.balancing import winds_and_starts
from safedpa_lab.pendulum.methods import model_named
from safedpa_lab.pendulum.rollouts import Closed, Swung, physics_in_any_wind, swung
from safedpa_sim.pendulum.task import AHEAD, BALANCING, LONG_WAY_ROUND, TORQUE, UPRIGHT, filter_settings

__all__ = ["COVERAGE", "measured_margin", "one_step_errors_ahead"]

Floats = NDArray[np.float64]
COVERAGE = 0.99
_TICKS = 250
_HELD_TICKS = 20
"""A torque drawn in the long way round is held for so long: drawn anew in each period it would lead nowhere."""


def measured_margin(folder: Path, seed: int, directions: int = 24) -> dict[str, Any]:
    """epsilon [rad] of stated coverage, and its coverage on other swings.

    Random swings in both corridors, in winds of so many directions, behind a filter that knows the wind; the history
    encoder looks on. An error is |predicted - measured| of s = angle + AHEAD rate one period later, with the encoder's
    latent, once its history is full.
    """
    first, second = (_errors(folder, one, directions) for one in (10_000 + 2 * seed, 10_001 + 2 * seed))
    epsilon = split_conformal_margin(first, COVERAGE)
    return {
        "epsilon": epsilon,
        "coverage": COVERAGE,
        "transitions": len(first),
        "median_error": float(np.median(first)),
        "fresh_coverage": float((second <= epsilon).mean()),
        "fresh_transitions": len(second),
        "fingerprint": fingerprint(model_named("learned", folder)),
    }


def _errors(folder: Path, seed: int, directions: int) -> Floats:
    model = model_named("learned", folder)
    looked_on = Closed(filter_settings(0.0), physics_in_any_wind(), model, told=True)
    errors = []
    for edges, hold in ((BALANCING, 1), (LONG_WAY_ROUND, _HELD_TICKS)):
        wind, start = winds_and_starts(directions, 1, seed)
        if edges is LONG_WAY_ROUND:
            start[:, 0] += 0.5 * (edges[0] + UPRIGHT)
        swings = swung(looked_on, _held_at_random(seed, hold), start, wind, edges, _TICKS)
        errors.append(one_step_errors_ahead(model, swings)[_full_history(model) :].ravel())
    return np.concatenate(errors)


def _held_at_random(seed: int, hold: int) -> Any:
    """Torques drawn uniformly over the bounds, each held for so many periods."""
    random = np.random.default_rng([seed, 24])
    kept: dict[str, Any] = {"age": 0}

    def wish(state: Floats, _latent: Floats) -> Floats:
        if kept["age"] % hold == 0:
            kept["torque"] = random.uniform(-TORQUE, TORQUE, (len(state), 1))
        kept["age"] += 1
        return np.array(kept["torque"])

    return wish


def _full_history(model: Any) -> int:
    return int(model.base.weights.description.history)


def one_step_errors_ahead(model: Any, swings: Swung) -> Floats:
    """(ticks, n) |predicted - measured| of s = angle + AHEAD rate, by a learned model with the encoder's latents."""
    before, torque = swings.states[:-1], swings.torques[..., np.newaxis]
    shape = before.shape[:2]
    flat = before.reshape(-1, 2), torque.reshape(-1, 1), swings.latents.reshape(-1, swings.latents.shape[-1])
    predicted = model.advance(flat[0], flat[1], model.initial_memory(flat[1], flat[2]), flat[2])[0]
    error = np.asarray(predicted).reshape(*shape, 2) - swings.states[1:]
    return np.abs(error[..., 0] + AHEAD * error[..., 1])
