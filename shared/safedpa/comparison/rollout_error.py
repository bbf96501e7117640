"""The one number by which models are compared with measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.rollout import rollout_at
from safedpa.comparison.windows import Windows
from safedpa.dynamics import PhysicsModel

__all__ = [
    "TRIM",
    "RolloutError",
    "change_scale",
    "error_of",
    "prediction_errors",
    "rollout_error",
    "scaled_error",
    "trimmed_rms",
]

TRIM = 0.05
"""Share of the largest errors that is left out: hands that push and glitches of the tracking are in real logs."""


@dataclass(frozen=True)
class RolloutError:
    """Error of open-loop predictions; 1 is about what "no change" earns, 0 is perfect.

    value: mean of per_state over the states that changed at all. per_state (states,): trimmed root mean square error
    over scale. scale (states,): standard deviation of the measured change over the horizon, in the state's unit.
    """

    value: float
    per_state: FloatArray
    scale: FloatArray


def rollout_error(model: PhysicsModel, windows: Windows) -> RolloutError:
    """The held-out error: open-loop rollouts over the windows' horizon, judged at their last row.

    per_state = trimmed_rms(predicted - measured) / std(measured end - measured start); value = mean(per_state).
    """
    rows = windows.end
    return error_of(windows, rows, rollout_at(model, windows, [rows])[0])


def error_of(windows: Windows, rows: IndexArray, predicted: FloatArray) -> RolloutError:
    """The same for predictions (windows, states) at one row a window, wherever they come from."""
    scale = change_scale(windows, rows)
    return scaled_error(trimmed_rms(prediction_errors(windows, rows, predicted)), scale)


def prediction_errors(windows: Windows, rows: IndexArray, predicted: FloatArray) -> FloatArray:
    """predicted - measured at one row a window, shape (windows, states); angles by the short way round.

    A prediction that grew without bound leaves infinite or NaN errors.
    """
    with np.errstate(invalid="ignore"):
        return windows.system.difference(predicted, windows.states[rows])


def scaled_error(rms: FloatArray, scale: FloatArray) -> RolloutError:
    """per_state = rms / scale, NaN where a state never changed; their mean over the others."""
    moved = scale > 0
    per_state = np.full(len(scale), np.nan)
    per_state[moved] = rms[moved] / scale[moved]
    return RolloutError(float(per_state[moved].mean()) if moved.any() else float("nan"), per_state, scale)


def change_scale(windows: Windows, rows: IndexArray) -> FloatArray:
    """Standard deviation over the windows of the measured change from start to ``rows``, shape (states,).

    Angles by the short way round. Changes below 1e-9 in size count as none.
    """
    change = windows.system.difference(windows.states[rows], windows.states[windows.start])
    spread = change.std(axis=0)
    return np.asarray(np.where(spread > 1e-9, spread, 0.0))


def trimmed_rms(errors: FloatArray, trim: float = TRIM) -> NDArray[np.float64]:
    """sqrt(mean of the squares) per column without the floor(trim n) largest squares, shape (states,).

    An error that is not finite counts as infinite.
    """
    with np.errstate(over="ignore"):
        squares = np.where(np.isfinite(errors), errors, np.inf) ** 2
    retained = len(squares) - int(trim * len(squares))
    smallest = np.partition(squares, retained - 1, axis=0)[:retained]
    return np.asarray(np.sqrt(smallest.mean(axis=0)))
