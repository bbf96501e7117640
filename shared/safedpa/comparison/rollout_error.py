"""The rollout error: the one measure by which models are compared with recordings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.rollout import rollout_at
from safedpa.comparison.windows import Windows
from safedpa.dynamics import PhysicsModel

TRIM = 0.05
"""Share of the largest errors that is left out: real logs contain people who push the robot, and tracking glitches."""


@dataclass(frozen=True)
class RolloutError:
    """Error of open-loop predictions: 0 is perfect, 1 is about the error of predicting no change.

    ``value`` is the mean of ``per_state`` over the states that changed. ``per_state`` (states,) is the trimmed root
    mean square error over ``scale``. ``scale`` (states,) is the standard deviation of the measured change over the
    horizon, in the state's unit.
    """

    value: float
    per_state: FloatArray
    scale: FloatArray


def rollout_error(model: PhysicsModel, windows: Windows) -> RolloutError:
    """Computes the error of open-loop rollouts at the last row of each window.

    per_state = trimmed_rms(predicted - measured) / std(measured end - measured start); value = mean(per_state).
    """
    rows = windows.end
    return error_of(windows, rows, rollout_at(model, windows, [rows])[0])


def error_of(windows: Windows, rows: IndexArray, predicted: FloatArray) -> RolloutError:
    """Computes the rollout error of any predictions (windows, states) at one row per window."""
    scale = change_scale(windows, rows)
    return scaled_error(trimmed_rms(prediction_errors(windows, rows, predicted)), scale)


def prediction_errors(windows: Windows, rows: IndexArray, predicted: FloatArray) -> FloatArray:
    """Returns predicted - measured at one row per window (windows, states), with angle differences wrapped.

    Errors of a diverged prediction are infinite or NaN.
    """
    with np.errstate(invalid="ignore"):
        return windows.system.difference(predicted, windows.states[rows])


def scaled_error(rms: FloatArray, scale: FloatArray) -> RolloutError:
    """Returns per_state = rms / scale (NaN for a state that never changed) and the mean over the others."""
    moved = scale > 0
    per_state = np.full(len(scale), np.nan)
    per_state[moved] = rms[moved] / scale[moved]
    return RolloutError(float(per_state[moved].mean()) if moved.any() else float("nan"), per_state, scale)


def change_scale(windows: Windows, rows: IndexArray) -> FloatArray:
    """Returns the standard deviation over the windows of the measured change from start to ``rows``, (states,).

    Angle differences are wrapped. A deviation below 1e-9 counts as 0.
    """
    change = windows.system.difference(windows.states[rows], windows.states[windows.start])
    spread = change.std(axis=0)
    return np.asarray(np.where(spread > 1e-9, spread, 0.0))


def trimmed_rms(errors: FloatArray, trim: float = TRIM) -> NDArray[np.float64]:
    """Returns sqrt(mean of the squares) per column without the floor(trim n) largest squares, (states,).

    An error that is not finite counts as infinite.
    """
    with np.errstate(over="ignore"):
        squares = np.where(np.isfinite(errors), errors, np.inf) ** 2
    retained = len(squares) - int(trim * len(squares))
    smallest = np.partition(squares, retained - 1, axis=0)[:retained]
    return np.asarray(np.sqrt(smallest.mean(axis=0)))


LOOK_BACK = 0.1
"""Interval [s] before the start over which rates are measured (one row if rows are further apart): long enough to
average the noise of motion capture and encoders, short compared with the motion of a car or pendulum."""


def no_change(windows: Windows, rows: IndexArray) -> FloatArray:
    """Returns x(t) = x(start), (windows, states), for any row."""
    del rows
    return windows.states[windows.start]


def constant_velocity(windows: Windows, rows: IndexArray) -> FloatArray:
    """Returns x(t) = x(start) + measured rates (t - start) at one row per window, (windows, states)."""
    seconds = windows.clock[rows] - windows.clock[windows.start]
    return np.asarray(windows.states[windows.start] + measured_rates(windows) * seconds[:, None])


def measured_rates(windows: Windows) -> FloatArray:
    """Returns (x(start) - x(start - 0.1 s)) / 0.1 s from rows of the same stretch, (windows, states).

    Angle differences are wrapped. The rate is 0 for a window that starts at the first row of its stretch.
    """
    past = np.searchsorted(windows.clock, windows.clock[windows.start] - LOOK_BACK - 1e-9)
    past = np.maximum(np.minimum(past, windows.start - 1), windows.begin)
    seconds = windows.clock[windows.start] - windows.clock[past]
    change = windows.system.difference(windows.states[windows.start], windows.states[past])
    return np.asarray(change / np.where(seconds > 0, seconds, np.inf)[:, None])


def naive_errors(windows: Windows) -> dict[str, float]:
    """Returns the rollout error of each naive predictor at the ends of the windows, by name."""
    found = {"no_change": no_change(windows, windows.end), "constant_velocity": constant_velocity(windows, windows.end)}
    return {name: error_of(windows, windows.end, predicted).value for name, predicted in found.items()}
