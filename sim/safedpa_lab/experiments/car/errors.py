"""Prediction errors of the models on fresh drives of the pymunk car with every load: one step and one second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.networks import frame_of
from safedpa_lab.experiments.car.drives import Drive
from safedpa_lab.experiments.car.predictor import predictor_of

STEPS = 20
"""One second at 20 Hz."""
OWN_STATES = ("along", "across", "yaw", "speed")
"""Errors are in the car's own frame: m, m, rad, m/s."""
_FIRST = 60
"""Tick from which predictions count: the history encoder has seen as much as it ever will."""
_EVERY = 5
"""Ticks from one start of an open-loop prediction to the next."""


def increment_scale(models: Sequence[PhysicsModel], drives: Sequence[Drive]) -> FloatArray:
    """(states,) what errors are divided by: the scale in which the first learned model was trained, else the root mean
    square of the change of state in one step of the drives, in the car's own frame."""
    for model in models:
        if isinstance(model.base, LearnedBase):
            return model.base.weights["increment_scale"].astype(np.float64)
    frame = frame_of("car")
    changes = np.concatenate([frame.own_increment(drive.states[:-1], drive.states[1:]) for drive in drives])
    return np.asarray(np.sqrt(np.mean(changes**2, axis=0)))


def errors_of_model(model: PhysicsModel, drives: Sequence[Drive], scale: FloatArray) -> dict[str, Any]:
    """By load and mixed: errors over one step and one second.

    ``number`` = mean over the states of sqrt(mean over the steps (error / scale)^2), errors in the car's own frame.
    """
    loads = [drive.loads[0] for drive in drives]
    parts = [_errors(model, drive) for drive in drives]
    rows = {}
    for load in (*dict.fromkeys(loads), "mixed"):
        chosen = [part for part, own in zip(parts, loads, strict=True) if load in (own, "mixed")]
        rows[load] = {
            "one_step": _summary(np.concatenate([one for one, _ in chosen]), scale),
            "one_second": _summary(np.concatenate([second for _, second in chosen]), scale),
        }
    return rows


def error_ratios(errors: Mapping[str, Any], worse: str, better: str) -> dict[str, dict[str, float]]:
    """By load and mixed: the number of ``worse`` over that of ``better``, for one step and for one second."""
    return {
        load: {
            horizon: errors[worse][load][horizon]["number"] / errors[better][load][horizon]["number"]
            for horizon in ("one_step", "one_second")
        }
        for load in errors[better]
    }


def _errors(model: PhysicsModel, drive: Drive) -> tuple[FloatArray, FloatArray]:
    """Own-frame errors (steps, states) over one step, and at the end of one second (starts, states)."""
    frame, predictor, states = frame_of("car"), predictor_of(model, drive), drive.states
    one_step = frame.own_increment(states[1:], predictor.one_step())[_FIRST:]
    starts = range(_FIRST, len(states) - STEPS, _EVERY)
    ends = predictor.rollouts(starts, STEPS)[:, -1]
    return one_step, frame.own_increment(states[[start + STEPS for start in starts]], ends)


def _summary(errors: FloatArray, scale: FloatArray) -> dict[str, Any]:
    per_state = np.sqrt(np.mean((errors / scale) ** 2, axis=0))
    physical = np.sqrt(np.mean(errors**2, axis=0))
    return {
        "number": float(per_state.mean()),
        "per_state": dict(zip(OWN_STATES, per_state.tolist(), strict=True)),
        "root_mean_square": dict(zip(OWN_STATES, physical.tolist(), strict=True)),
        "position": float(np.hypot(physical[0], physical[1])),
        "count": len(errors),
    }
