"""The paper's figure of predicted trajectories: what each model expects after the first ten steps of a drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safedpa.dynamics import PhysicsModel
from safedpa_lab.experiments.car.drives import Drive
from safedpa_lab.experiments.car.predictor import predictor_of

FIRST_STEPS = 10
"""Steps of a drive that are known when the prediction starts."""
PREDICTED_STEPS = 50
"""Steps that are predicted: 2.5 s."""


def predicted_paths(models: Mapping[str, PhysicsModel], drives: Sequence[Drive]) -> list[dict[str, Any]]:
    """For each drive: the driven path, and each model's from step 10 on, under the actions that were driven."""
    return [_paths(models, drive) for drive in drives]


def _paths(models: Mapping[str, PhysicsModel], drive: Drive) -> dict[str, Any]:
    steps = min(PREDICTED_STEPS, len(drive.actions) - FIRST_STEPS)
    driven = drive.states[: FIRST_STEPS + steps + 1]
    predicted = {}
    for name, model in models.items():
        path = predictor_of(model, drive).rollouts([FIRST_STEPS], steps)[0]
        miss = np.hypot(*(path[:, :2] - driven[FIRST_STEPS + 1 :, :2]).T)
        predicted[name] = {"path": np.round(path[:, :2], 4).tolist(), "miss_at_end": float(miss[-1])}
    return {"load": drive.loads[0], "driven": np.round(driven[:, :2], 4).tolist(), "predicted": predicted}
