"""The held-out error: rollouts of every window by a model that was fitted without the window's fold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from safedpa.diagnosis.fitting import Fit, moved
from safedpa.diagnosis.rollout import rollout_at
from safedpa.diagnosis.rollout_error import change_scale, prediction_errors, scaled_error, trimmed_rms
from safedpa.diagnosis.shooting import Shooting, folds_of
from safedpa.diagnosis.windows import Floats, Rows, Windows, windows_of
from safedpa.records.run import Run

__all__ = ["Heldout", "HeldoutError", "error_with", "heldout_of"]

_MOST_WINDOWS = 1200


@dataclass(frozen=True)
class Heldout:
    """Windows of the horizon over all runs, and the fold of each."""

    windows: Windows
    fold: Rows


@dataclass(frozen=True)
class HeldoutError:
    """value: mean over the states; per_state (states,); by_run (runs,), on the scale of all runs, NaN without windows.

    ``by_run_and_state`` (runs, states): the same state by state. ``errors`` (windows, states): predicted - measured at
    the windows' ends.
    """

    value: float
    per_state: Floats
    by_run: Floats
    by_run_and_state: Floats
    errors: Floats


def heldout_of(runs: Sequence[Run], horizon: float, folds: int = 6) -> Heldout:
    """Windows from every tenth of a second, fewer where the logs are long."""
    seconds = sum(run.duration for run in runs)
    windows = windows_of(runs, horizon, every=max(0.1, seconds / _MOST_WINDOWS))
    return Heldout(windows, folds_of(windows, folds))


def error_with(fitted: Fit, shooting: Shooting, heldout: Heldout) -> HeldoutError:
    """The error of the model when each fold is predicted with parameters fitted without it."""
    windows = heldout.windows
    predicted = np.full((len(windows), len(windows.system.state)), np.nan)
    for fold, values in fitted.without(shooting).items():
        own = np.flatnonzero(heldout.fold == fold)
        if len(own):
            model = moved(fitted.model, dict(zip(fitted.paths, values.tolist(), strict=True)))
            part = windows.select(own)
            predicted[own] = rollout_at(model, part, [part.end])[0]
    left = np.isnan(predicted).all(axis=1)
    if left.any():
        part = windows.select(np.flatnonzero(left))
        predicted[left] = rollout_at(fitted.model, part, [part.end])[0]
    errors = prediction_errors(windows, windows.end, predicted)
    scale = change_scale(windows, windows.end)
    found = scaled_error(trimmed_rms(errors), scale)
    by_run = np.full(len(windows.names), np.nan)
    by_state = np.full((len(windows.names), errors.shape[1]), np.nan)
    for run in range(len(windows.names)):
        own = np.flatnonzero(windows.run == run)
        if len(own):
            one = scaled_error(trimmed_rms(errors[own]), scale)
            by_run[run], by_state[run] = one.value, one.per_state
    return HeldoutError(found.value, found.per_state, by_run, by_state, errors)
