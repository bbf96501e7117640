"""Naive predictors without physics: baselines that a model has to beat."""

from __future__ import annotations

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.windows import Windows

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
    from safedpa.comparison.rollout_error import error_of

    found = {"no_change": no_change(windows, windows.end), "constant_velocity": constant_velocity(windows, windows.end)}
    return {name: error_of(windows, windows.end, predicted).value for name, predicted in found.items()}
