"""Margins of the filters of the car experiment: one rule for all models, and their coverage on fresh drives.

The rule: epsilon of each kind of barrier is the split conformal quantile of the model's own one-step error of h, at
99 %, on the same recorded drives for every model. A model that predicts worse pays with a wider margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.adaptation import AdaptationNode
from safedpa.bus import LATENT, LatentMessage, StateMessage
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.errors import InputError
from safedpa.safety import FilterSettings
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.calibration import MarginCalibration
from safedpa.safety.margin import smallest_sample, split_conformal_margin
from safedpa.safety.scene import SceneBarriers
from safedpa_sim.experiments.car_drives import Drive
from safedpa_sim.experiments.statistics import wilson_interval

__all__ = ["COVERAGE", "CoverageCount", "conformal_margin", "coverage_of", "h_errors", "latents_along", "worst_errors"]

Values = NDArray[np.float64]

COVERAGE = 0.99
"""Share of steps that a margin covers, for each kind of barrier."""


def latents_along(model: PhysicsModel, drive: Drive) -> Values:
    """z[k] (n + 1, latents) as the real adaptation node says it in every tick of a recorded drive."""
    if not model.latent_names:
        return np.zeros((len(drive.messages), 0))
    node = AdaptationNode(model)
    rows = []
    for message in drive.messages:
        latent = node.step("r1", message, {})[LATENT]
        assert isinstance(latent, LatentMessage)
        rows.append(latent.values)
        node.afterwards("r1")
    return np.array(rows)


def h_errors(model: PhysicsModel, drives: Sequence[Drive], settings: FilterSettings) -> dict[str, Values]:
    """By kind of barrier (steps,): the worst h(predicted next state) - h(measured next state) over its barriers.

    The latents are the adaptation's at each tick; what the actuators remember is carried along each drive.
    """
    found: dict[str, list[float]] = {}
    for drive in drives:
        latents, scene = latents_along(model, drive), SceneBarriers(settings)
        memory: Any = model.initial_memory(np.array(drive.messages[0].applied))
        for before, after, latent in zip(drive.messages, drive.messages[1:], latents, strict=False):
            state, action = np.array(before.values), np.array(after.applied)
            expected, memory = model.advance(state, action, memory, latent, period=before.period)
            for kind, error in worst_errors(_barriers(scene, before), expected, np.array(after.values)).items():
                found.setdefault(kind, []).append(error)
    return {kind: np.array(errors) for kind, errors in found.items()}


def worst_errors(barriers: Sequence[AbstractBarrier], expected: Values, measured: Values) -> dict[str, float]:
    """By kind: max over its barriers of h(expected) - h(measured); positive where the model hoped too much."""
    errors: dict[str, float] = {}
    for part in barriers:
        worst = float((part.values(expected) - part.values(measured)).max(initial=-np.inf))
        errors[part.kind] = max(errors.get(part.kind, -np.inf), worst)
    return {kind: error for kind, error in errors.items() if np.isfinite(error)}


def conformal_margin(model: PhysicsModel, errors: dict[str, Values], date: str) -> MarginCalibration:
    """The margin that covers 99 % of the steps. Raises InputError when there are too few of them."""
    count = min((len(values) for values in errors.values()), default=0)
    if count < smallest_sample(COVERAGE):
        raise InputError(f"margin: got {count} steps, wanted at least {smallest_sample(COVERAGE)}; drive longer")
    epsilon = {kind: max(0.0, split_conformal_margin(values, COVERAGE)) for kind, values in errors.items()}
    return MarginCalibration(epsilon, COVERAGE, count, date, fingerprint(model))


def coverage_of(margin: MarginCalibration, fresh: dict[str, Values]) -> dict[str, Any]:
    """By kind: how many fresh errors the margin covers, with the 95 % Wilson interval, and the largest of them."""
    rows = {}
    for kind, errors in fresh.items():
        covered = int((errors <= margin.epsilon[kind]).sum())
        rows[kind] = {
            "epsilon": margin.epsilon[kind],
            "steps": len(errors),
            "covered": covered,
            "share": covered / len(errors),
            "interval_95": list(wilson_interval(covered, len(errors))),
            "largest_error": float(errors.max()),
        }
    return rows


@final
class CoverageCount:
    """Counts along one episode how often the calibrated margin covered the error of what the filter predicted."""

    def __init__(self, settings: FilterSettings, margin: MarginCalibration | None) -> None:
        self._scene, self._margin = SceneBarriers(settings), margin
        self._expected: Values | None = None
        self._barriers: Sequence[AbstractBarrier] = ()
        self.counts: dict[str, list[int]] = {}
        """By kind: steps covered, and all steps; empty without a margin."""

    def see(self, state: StateMessage, predicted: Sequence[Sequence[float]]) -> None:
        """One tick: the measured state, and the states that the filter expects after it."""
        if self._margin is None:
            return
        if self._expected is not None:
            errors = worst_errors(self._barriers, self._expected, np.array(state.values))
            for kind, error in errors.items():
                count = self.counts.setdefault(kind, [0, 0])
                count[0] += error <= self._margin.epsilon[kind]
                count[1] += 1
        self._barriers = _barriers(self._scene, state)
        self._expected = np.array(predicted[0]) if predicted else None


def _barriers(scene: SceneBarriers, message: StateMessage) -> Sequence[AbstractBarrier]:
    barriers = scene.of(message)
    if isinstance(barriers, str):
        raise InputError(f"recorded drive, tick {message.tick}: {barriers}; record it anew")
    return barriers
