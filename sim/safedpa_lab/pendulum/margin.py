"""The margin of each filter: the same rule, on as many drives, behind its own filter and of its own errors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.safety import split_conformal_margin
from safedpa.safety.margins.conformal import margins_over_drives
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.pendulum.difficulty import Difficulty, Episodes
from safedpa_lab.pendulum.methods import FILTERED, Method, model_named
from safedpa_lab.pendulum.questions import balanced, crossed
from safedpa_lab.pendulum.rollouts import Swung
from safedpa_sim.pendulum.task import AHEAD

COVERAGE: Final = 0.99
_ORACLE: Final = FILTERED[-1]


def measured_margins(methods: Sequence[Method], folder: Path, drives: int) -> dict[str, dict[str, Any]]:
    """By method, the margin of its filter: the same rule for each.

    In two rounds, since errors depend on where the filter lets the pendulum go: drives behind a filter that is given
    the wind make a first margin; other drives behind the filter itself with that margin make the one that counts. Each
    round has ``drives`` of each question, in the experiment's wind towards directions drawn at random, on seeds for
    calibration; no tick is left out.
    """
    seeds = seeds_for("calibration", 2)
    first = {}
    for method in methods:
        errors = _errors_by_drive(method, _ORACLE, folder, 0.0, seeds[0], drives)
        first[method.name] = max(0.0, margins_over_drives(errors, COVERAGE)[0])
    return {method.name: _second(method, folder, first[method.name], list(seeds), drives) for method in methods}


def _second(method: Method, folder: Path, first: float, seeds: list[int], drives: int) -> dict[str, Any]:
    """epsilon [rad] of the method's filter, of the stated coverage of a step of a drive that is not known."""
    errors = _errors_by_drive(method, method, folder, first, seeds[1], drives)
    epsilon, of_a_drive = margins_over_drives(errors, COVERAGE)
    every = np.concatenate(errors)
    return {
        "epsilon": max(0.0, epsilon),
        "first": first,
        "of_a_drive": of_a_drive,
        "steps_alone": split_conformal_margin(every, COVERAGE),
        "coverage": COVERAGE,
        "drives": len(errors),
        "transitions": len(every),
        "seeds": seeds,
        "largest_error": float(every.max()),
        "fingerprint": fingerprint(model_named(method.filter, folder)),
    }


def _errors_by_drive(
    method: Method, before: Method, folder: Path, epsilon: float, seed: int, drives: int
) -> list[FloatArray]:
    """Errors (ticks,) of the method's model along each drive behind the filter of ``before``, of both questions."""
    episodes = Episodes(seed, drives, 1, Difficulty(), anywhere=True)
    edges = episodes.difficulty.balancing, episodes.difficulty.long_way_round
    found: list[FloatArray] = []
    for swings, corridor in zip(_driven(before, folder, epsilon, episodes), edges, strict=True):
        found += list(errors_of(method, folder, swings, episodes.winds(), corridor).T)
    return found


@lru_cache(1)
def _driven(before: Method, folder: Path, epsilon: float, episodes: Episodes) -> tuple[Swung, Swung]:
    """Of both questions; the first round's drives are the same for every filter."""
    return balanced(before, folder, epsilon, episodes), crossed(before, folder, epsilon, episodes)


def errors_of(method: Method, folder: Path, swings: Swung, winds: FloatArray, edges: tuple[float, float]) -> FloatArray:
    """(ticks, n) the least h that the method's model predicts minus the least h that is measured, one period later.

    h = (s - low, high - s) with s = angle + AHEAD rate, of what the sensors tell; positive where the model hoped too
    much. The latent is the encoder's of the same tick, or the wind where the filter is given it.
    """
    model = model_named(method.filter, folder)
    before, torque = swings.seen[:-1], swings.torques[..., np.newaxis]
    latents = np.broadcast_to(winds, (len(before), *winds.shape)) if method.reported else swings.latents
    predicted = _advanced(model, before, torque, latents if model.latent_names else latents[..., :0])
    return _least_h(predicted, edges) - _least_h(swings.seen[1:], edges)


def _advanced(model: PhysicsModel, before: FloatArray, torque: FloatArray, latents: FloatArray) -> FloatArray:
    """States (ticks, n, 2) one period later, by the model."""
    rows = before.shape[0] * before.shape[1]
    state, action, latent = (part.reshape(rows, part.shape[-1]) for part in (before, torque, latents))
    following = model.advance(state, action, model.initial_memory(action, latent), latent)[0]
    return np.asarray(following).reshape(before.shape)


def _least_h(states: FloatArray, edges: tuple[float, float]) -> FloatArray:
    ahead = states[..., 0] + AHEAD * states[..., 1]
    return np.minimum(ahead - edges[0], edges[1] - ahead)


def covered_share(
    method: Method, folder: Path, swings: Swung, winds: FloatArray, edges: tuple[float, float], epsilon: float
) -> float:
    """The share of the steps whose error the margin covers."""
    return float((errors_of(method, folder, swings, winds, edges) <= epsilon).mean())
