"""What a history reveals about the wind: by the history encoder, and at best, by the true equations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa_lab.pendulum.difficulty import Episodes
from safedpa_lab.pendulum.methods import model_named
from safedpa_lab.pendulum.rollouts import Closed, Swung, believed_wind, physics_in_any_wind, swung
from safedpa_sim.pendulum.task import BALANCING, TORQUE, WIND

_TICKS = 300
_EVERY = 20
"""Ticks between two looks."""
_HELD = 20
"""Ticks for which a torque is held: redrawn in each it would lead nowhere."""
_ROUNDS = 12
_STEP = 1e-3
"""m/s; for the slopes."""
_REFINEMENTS = 4
_TRUST = 2e-3
"""(rad/s)2; of a network error of about 0.02 rad/s that is the same along a history, and 0.5 in the encoder's z."""
_NOISE = 0.0025
"""rad/s added to the measured rates for the best fit: what the encoder's training adds, 0.0005 of its scaled rows."""


def swung_all_around(folder: Path, episodes: Episodes) -> Swung:
    """Swings under torques at random without a filter, the history encoder looking on; constant winds of WIND [m/s]."""
    start, random = episodes.upright_starts(), episodes.random(25)
    start[:, 0] = random.uniform(-np.pi, np.pi, len(start))
    retained: dict[str, Any] = {"age": 0}

    def nominal_action(state: FloatArray, _latent: FloatArray) -> FloatArray:
        if retained["age"] % _HELD == 0:
            retained["torque"] = random.uniform(-TORQUE, TORQUE, (len(state), 1))
        retained["age"] += 1
        return np.array(retained["torque"])

    return swung(
        Closed(adapts=model_named("learned", folder)), nominal_action, start, episodes.winds(), BALANCING, _TICKS
    )


def fitted_wind(states: FloatArray, torques: FloatArray) -> FloatArray:
    """The wind (n, 2) [m/s] that explains histories best: least squares over the changes of rate, by Gauss-Newton.

    ``states`` (ticks + 1, n, 2), ``torques`` (ticks, n). The equations are the simulator's own.
    """
    model, count = physics_in_any_wind(), states.shape[1]
    before, after = states[:-1].reshape(-1, 2), states[1:, :, 1].ravel()
    torque = torques.reshape(-1, 1)
    wind = np.zeros((count, 2))
    for _ in range(_ROUNDS):
        left = (after - _rates(model, before, torque, wind)).reshape(-1, count)
        slope = np.stack(
            [
                (_rates(model, before, torque, wind + _STEP * axis) - after).reshape(-1, count) + left
                for axis in np.eye(2)
            ],
            axis=-1,
        )
        slope /= _STEP
        normal = np.einsum("tni,tnj->nij", slope, slope) + 1e-12 * np.eye(2)
        wind = np.clip(wind + np.linalg.solve(normal, np.einsum("tni,tn->ni", slope, left)[..., None])[..., 0], -8, 8)
    return wind


def _rates(model: PhysicsModel, before: FloatArray, torque: FloatArray, wind: FloatArray) -> FloatArray:
    """Rates one period later, (ticks * n,)."""
    every = np.tile(wind, (len(before) // len(wind), 1))
    return np.asarray(model.advance(before, torque, model.initial_memory(torque, every), every)[0][:, 1])


def refined_latent(model: PhysicsModel, latents: FloatArray, states: FloatArray, torques: FloatArray) -> FloatArray:
    """Latents (n, latents) that explain histories better, from those of the history encoder on.

    minimises the sum over the history of (change of rate - that of f + g a)^2 + TRUST |z - encoder's z|^2, by
    Gauss-Newton; the networks' own error lets TRUST not be 0. ``states`` (ticks + 1, n, 2), ``torques`` (ticks, n).
    """
    before, after = states[:-1].reshape(-1, 2), states[1:, :, 1].ravel()
    torque, count, found = torques.reshape(-1, 1), len(latents), np.array(latents)
    axes = np.eye(latents.shape[1])
    for _ in range(_REFINEMENTS):
        rates = _rates(model, before, torque, found)
        left = (after - rates).reshape(-1, count)
        moved = [_rates(model, before, torque, found + _STEP * axis) - rates for axis in axes]
        slope = np.stack([part.reshape(-1, count) / _STEP for part in moved], axis=-1)
        normal = np.einsum("tni,tnj->nij", slope, slope) + _TRUST * axes
        pull = np.einsum("tni,tn->ni", slope, left) + _TRUST * (latents - found)
        found = found + np.linalg.solve(normal, pull[..., None])[..., 0]
    return found


def recovery(swings: Swung, folder: Path, directions: int, seed: int) -> dict[str, Any]:
    """How far the wind's direction is off [degrees], from the latent and by the best fit to the same histories.

    Once the history is full. ``latents`` and ``directions`` are those of the swings' ends, for a picture.
    """
    model = model_named("learned", folder)
    history = model.base.weights.description.history  # type: ignore[attr-defined]
    episodes = swings.states.shape[1] // directions
    true = np.repeat(2 * np.pi * np.arange(directions) / directions, episodes)
    ticks = np.arange(history, len(swings.latents), _EVERY)
    reported = _off(believed_wind(model, swings.latents[ticks], WIND), true)
    noisy = swings.states + np.random.default_rng([seed, 26]).normal(0.0, [0.0, _NOISE], swings.states.shape)
    fits = [_fit_off(states, swings.torques, ticks, history, true) for states in (swings.states, noisy)]
    last = int(ticks[-1])
    refined = refined_latent(
        model, swings.latents[last], swings.states[last - history : last + 1], swings.torques[last - history : last]
    )
    corrected = _off(believed_wind(model, refined, WIND), true)
    return {
        "median_degrees": float(np.median(reported)),
        "refined_median_degrees": float(np.median(corrected)),
        "refined_90_degrees": float(np.quantile(corrected, 0.9)),
        "refined": np.round(refined, 4).tolist(),
        "90_degrees": float(np.quantile(reported, 0.9)),
        "best_median_degrees": float(np.median(fits[0])),
        "best_noisy_median_degrees": float(np.median(fits[1])),
        "best_noisy_90_degrees": float(np.quantile(fits[1], 0.9)),
        "latents": np.round(swings.latents[last], 4).tolist(),
        "directions": np.degrees(true).round(2).tolist(),
    }


def _fit_off(
    states: FloatArray, torques: FloatArray, ticks: NDArray[np.intp], history: int, true: FloatArray
) -> FloatArray:
    winds = [fitted_wind(states[tick - history : tick + 1], torques[tick - history : tick]) for tick in ticks]
    return np.stack([_off(np.arctan2(wind[:, 1], wind[:, 0]), true) for wind in winds])


def _off(believed: FloatArray, true: FloatArray) -> FloatArray:
    return np.degrees(np.abs((believed - true + np.pi) % (2 * np.pi) - np.pi))
