"""The held-out error: each window is predicted by a model that was fitted without the window's fold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.rollout import rollout_at
from safedpa.comparison.rollout_error import change_scale, prediction_errors, scaled_error, trimmed_rms
from safedpa.comparison.windows import Windows, windows_of
from safedpa.diagnosis.fit.least_squares import Fit, with_values
from safedpa.diagnosis.fit.multiple_shooting import Shooting, folds_of, halfway_between_rows
from safedpa.records.run import Run

# 1200 rollouts bound the run time; overlapping windows beyond that are too correlated to sharpen the mean.
_MAX_WINDOWS = 1200


@dataclass(frozen=True)
class Heldout:
    """Windows of one horizon over all runs, and the fold of each window."""

    windows: Windows
    fold: IndexArray
    recorded: Windows | None = None
    """The windows as recorded, where ``windows`` has commands that change between rows."""

    def with_commands(self, *, between_rows: bool) -> Heldout:
        """Returns the windows with commands that change at the rows that show them, or half a period before."""
        if between_rows == (self.recorded is not None):
            return self
        if self.recorded is not None:
            return Heldout(self.recorded, self.fold)
        return Heldout(halfway_between_rows(self.windows), self.fold, self.windows)


@dataclass(frozen=True)
class HeldoutError:
    """Error on data that was not used for fitting, as a mean and by state, run and fold.

    ``value`` is the mean over the states of ``per_state`` (states,). ``by_run`` (runs,) and ``by_run_and_state``
    (runs, states) use the scale of all runs; they are NaN for a run without windows. ``by_fold`` (folds,) is the error
    of each fold; folds are whole runs where there are three or more. ``errors`` (windows, states): predicted - measured
    at the ends of the windows.
    """

    value: float
    per_state: FloatArray
    by_run: FloatArray
    by_run_and_state: FloatArray
    by_fold: FloatArray
    errors: FloatArray

    @property
    def standard_error(self) -> float:
        """Standard error of the mean over the folds: std(by_fold) / sqrt(folds); 0 for fewer than two folds."""
        finite = self.by_fold[np.isfinite(self.by_fold)]
        return float(finite.std(ddof=1) / np.sqrt(len(finite))) if len(finite) > 1 else 0.0

    def improved_runs(self, before: HeldoutError) -> str:
        """Returns in how many runs the error fell, such as ``4/5``."""
        # NaN marks runs without windows, which are neither better nor worse.
        both = np.isfinite(before.by_run) & np.isfinite(self.by_run)
        return f"{int((self.by_run[both] < before.by_run[both]).sum())}/{int(both.sum())}"


def heldout_of(runs: Sequence[Run], horizon: float, folds: int = 6) -> Heldout:
    """Returns overlapping windows that start every 0.1 s, or less often in long recordings."""
    seconds = sum(run.duration for run in runs)
    windows = windows_of(runs, horizon, every=max(0.1, seconds / _MAX_WINDOWS))
    return Heldout(windows, folds_of(windows, folds))


def error_with(fitted: Fit, shooting: Shooting, heldout: Heldout) -> HeldoutError:
    """Returns the error of the model when each fold is predicted with parameters fitted without it.

    A prediction that is not finite counts as an infinite error. Folds without fitting windows are predicted with the
    parameters of the fit to all data.
    """
    windows = heldout.windows
    # NaN marks windows that no model predicted: trimmed_rms counts them as infinite errors.
    predicted = np.full((len(windows), len(windows.system.state)), np.nan)
    unpredicted = np.ones(len(windows), dtype=bool)
    for fold, values in fitted.without(shooting).items():
        members = np.flatnonzero(heldout.fold == fold)
        if len(members):
            model = with_values(fitted.model, dict(zip(fitted.paths, values.tolist(), strict=True)))
            part = windows.select(members)
            predicted[members], unpredicted[members] = rollout_at(model, part, [part.end])[0], False
    if unpredicted.any():
        part = windows.select(np.flatnonzero(unpredicted))
        predicted[unpredicted] = rollout_at(fitted.model, part, [part.end])[0]
    errors = prediction_errors(windows, windows.end, predicted)
    # One scale for all runs, so that the errors of runs, folds and states can be compared and averaged.
    scale = change_scale(windows, windows.end)
    found = scaled_error(trimmed_rms(errors), scale)
    by_run, by_state = _by_group(errors, scale, windows.run, len(windows.names))
    by_fold, _ = _by_group(errors, scale, heldout.fold, int(heldout.fold.max(initial=0)) + 1)
    return HeldoutError(found.value, found.per_state, by_run, by_state, by_fold, errors)


def _by_group(errors: FloatArray, scale: FloatArray, group: IndexArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Returns the errors of each group of windows: the mean (groups,) and per state (groups, states); NaN if empty."""
    value, by_state = np.full(count, np.nan), np.full((count, errors.shape[1]), np.nan)
    for number in range(count):
        members = np.flatnonzero(group == number)
        if len(members):
            one = scaled_error(trimmed_rms(errors[members]), scale)
            # Scaled like the whole, because a run with little motion would have a tiny scale of its own.
            value[number], by_state[number] = one.value, one.per_state
    return value, by_state
