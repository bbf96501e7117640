"""The margin of the point robot's filter, from one-step errors of h on drives that no network was trained on."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from safedpa.networks import Weights
from safedpa.safety import split_conformal_margin
from safedpa_lab.point.beliefs import LearnedBelief
from safedpa_lab.point.moments import Moments, drawn_moments
from safedpa_lab.point.shield import weights_named
from safedpa_sim.point.filtering import least_room
from safedpa_sim.point.policy_task import LARGEST_FORCE

__all__ = ["COVERAGE", "measured_margin", "one_step_errors"]

Floats = NDArray[np.float64]

COVERAGE: Final = 0.99


def measured_margin(folder: Path, seed: int = 0, *, robots: int = 192, steps: int = 400) -> dict[str, Any]:
    """epsilon [m] of stated coverage, and its coverage on other drives, in winds of 0.008 N all around.

    An error is by how much h at the prediction exceeds h at what was measured one period later, both by what SafeDPA
    believes, where h is between 0 and 0.1 m and the history is full.
    """
    weights = weights_named("learned", folder)
    first, second = (_errors(weights, one, robots, steps) for one in (20_000 + 2 * seed, 20_001 + 2 * seed))
    epsilon = max(0.0, split_conformal_margin(first, COVERAGE))
    return {
        "epsilon": epsilon,
        "coverage": COVERAGE,
        "transitions": len(first),
        "median_error": float(np.median(np.abs(first))),
        "fresh_coverage": float((second <= epsilon).mean()),
        "fresh_transitions": len(second),
    }


def one_step_errors(weights: Weights, moments: Moments) -> Floats:
    """(n,) h(predicted) - h(measured) [m] one period later, least over hazards, by f, g and the latents of phi."""
    believed = LearnedBelief(weights).believed(moments.state, moments.latent)
    predicted = believed.next_state(moments.action)
    errors: Floats = least_room(predicted, moments.hazards, believed.motion) - least_room(
        moments.following, moments.hazards, believed.motion
    )
    return errors


def _errors(weights: Weights, seed: int, robots: int, steps: int) -> Floats:
    drawn = drawn_moments(weights, robots=robots, steps=steps, seed=seed, force=LARGEST_FORCE)
    return one_step_errors(weights, drawn)
