"""Predictors that know no physics: a model must beat them to be worth its name."""

from __future__ import annotations

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.windows import Windows

__all__ = ["LOOK_BACK", "constant_velocity", "measured_rates", "naive_errors", "no_change"]

LOOK_BACK = 0.1
"""s; measured rates are the change over this past (one row where rows are further apart): long enough to average the
noise of motion capture and encoders, short next to the motions of a car or pendulum."""


def no_change(windows: Windows, rows: IndexArray) -> FloatArray:
    """x(t) = x(start), shape (windows, states), whatever the row."""
    del rows
    return windows.states[windows.start]


def constant_velocity(windows: Windows, rows: IndexArray) -> FloatArray:
    """x(t) = x(start) + measured rates (t - start) at one row a window, shape (windows, states)."""
    seconds = windows.clock[rows] - windows.clock[windows.start]
    return np.asarray(windows.states[windows.start] + measured_rates(windows) * seconds[:, None])


def measured_rates(windows: Windows) -> FloatArray:
    """(x(start) - x(start - 0.1 s)) / 0.1 s from rows of the same stretch, shape (windows, states).

    Angles by the short way round; zero for a window that starts at the first row of its stretch.
    """
    past = np.searchsorted(windows.clock, windows.clock[windows.start] - LOOK_BACK - 1e-9)
    past = np.maximum(np.minimum(past, windows.start - 1), windows.begin)
    seconds = windows.clock[windows.start] - windows.clock[past]
    change = windows.system.difference(windows.states[windows.start], windows.states[past])
    return np.asarray(change / np.where(seconds > 0, seconds, np.inf)[:, None])


def naive_errors(windows: Windows) -> dict[str, float]:
    """The rollout error at the windows' ends of each of them, by name."""
    from safedpa.comparison.rollout_error import error_of

    found = {"no_change": no_change(windows, windows.end), "constant_velocity": constant_velocity(windows, windows.end)}
    return {name: error_of(windows, windows.end, predicted).value for name, predicted in found.items()}
