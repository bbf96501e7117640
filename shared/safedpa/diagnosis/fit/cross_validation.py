"""The held-out error: rollouts of every window by a model that was fitted without the window's fold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.rollout import rollout_at
from safedpa.comparison.rollout_error import change_scale, prediction_errors, scaled_error, trimmed_rms
from safedpa.comparison.windows import Windows, windows_of
from safedpa.diagnosis.fit.least_squares import Fit, with_values
from safedpa.diagnosis.fit.multiple_shooting import Shooting, folds_of
from safedpa.records.run import Run

__all__ = ["Heldout", "HeldoutError", "error_with", "heldout_of"]

_MOST_WINDOWS = 1200


@dataclass(frozen=True)
class Heldout:
    """Windows of the horizon over all runs, and the fold of each."""

    windows: Windows
    fold: IndexArray


@dataclass(frozen=True)
class HeldoutError:
    """value: mean over the states; per_state (states,); by_run (runs,), on the scale of all runs, NaN without windows.

    ``by_run_and_state`` (runs, states): the same state by state. ``by_fold`` (folds,): that of what is held out
    together, whole runs where there are three or more. ``errors`` (windows, states): predicted - measured at the
    windows' ends.
    """

    value: float
    per_state: FloatArray
    by_run: FloatArray
    by_run_and_state: FloatArray
    by_fold: FloatArray
    errors: FloatArray

    @property
    def standard_error(self) -> float:
        """Of the mean over the folds: std(by_fold) / sqrt(folds); 0 for fewer than two."""
        own = self.by_fold[np.isfinite(self.by_fold)]
        return float(own.std(ddof=1) / np.sqrt(len(own))) if len(own) > 1 else 0.0


def heldout_of(runs: Sequence[Run], horizon: float, folds: int = 6) -> Heldout:
    """Windows from every tenth of a second, fewer where the logs are long."""
    seconds = sum(run.duration for run in runs)
    windows = windows_of(runs, horizon, every=max(0.1, seconds / _MOST_WINDOWS))
    return Heldout(windows, folds_of(windows, folds))


def error_with(fitted: Fit, shooting: Shooting, heldout: Heldout) -> HeldoutError:
    """The error of the model when each fold is predicted with parameters fitted without it.

    What such a model cannot predict counts as infinite; folds of which the fit has no windows are predicted by all.
    """
    windows = heldout.windows
    predicted = np.full((len(windows), len(windows.system.state)), np.nan)
    left = np.ones(len(windows), dtype=bool)
    for fold, values in fitted.without(shooting).items():
        own = np.flatnonzero(heldout.fold == fold)
        if len(own):
            model = with_values(fitted.model, dict(zip(fitted.paths, values.tolist(), strict=True)))
            part = windows.select(own)
            predicted[own], left[own] = rollout_at(model, part, [part.end])[0], False
    if left.any():
        part = windows.select(np.flatnonzero(left))
        predicted[left] = rollout_at(fitted.model, part, [part.end])[0]
    errors = prediction_errors(windows, windows.end, predicted)
    scale = change_scale(windows, windows.end)
    found = scaled_error(trimmed_rms(errors), scale)
    by_run, by_state = _by_group(errors, scale, windows.run, len(windows.names))
    by_fold, _ = _by_group(errors, scale, heldout.fold, int(heldout.fold.max(initial=0)) + 1)
    return HeldoutError(found.value, found.per_state, by_run, by_state, by_fold, errors)


def _by_group(errors: FloatArray, scale: FloatArray, group: IndexArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Errors of each group of windows (groups,) and state by state (groups, states), NaN without windows."""
    value, by_state = np.full(count, np.nan), np.full((count, errors.shape[1]), np.nan)
    for number in range(count):
        own = np.flatnonzero(group == number)
        if len(own):
            one = scaled_error(trimmed_rms(errors[own]), scale)
            value[number], by_state[number] = one.value, one.per_state
    return value, by_state
