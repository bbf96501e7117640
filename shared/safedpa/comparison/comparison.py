"""Compares a model with recordings: the data that ``safedpa compare`` prints and draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.excerpt import without_duplicates
from safedpa.comparison.rollout import rollout_at
from safedpa.comparison.rollout_error import (
    RolloutError,
    constant_velocity,
    error_of,
    no_change,
    prediction_errors,
    scaled_error,
    trimmed_rms,
)
from safedpa.comparison.where import Cell, Factor, cells, factors, window_errors
from safedpa.comparison.windows import Windows, windows_of
from safedpa.dynamics import PhysicsModel
from safedpa.limits import readable
from safedpa.records.run import Finding, Run
from safedpa.result import one_line

__all__ = [
    "EVERY",
    "PREDICTORS",
    "Comparison",
    "HorizonError",
    "PerRunError",
    "Residuals",
    "compare_model",
    "residuals",
    "with_distinct_names",
]

SHORT = 0.2
"""Time [s] after which residual rates are taken: long enough to average the noise, short enough to stay local."""


@dataclass(frozen=True)
class Residuals:
    """Rates that the model lacks: ``rates`` (windows, states) = (measured - predicted) / seconds, in state units/s.

    ``values`` (windows, variables) are the measured states, then the actions, at the windows' starts.
    """

    seconds: float
    rates: FloatArray
    values: FloatArray


def residuals(windows: Windows, rows: Sequence[IndexArray], predicted: FloatArray) -> Residuals:
    """Computes residual rates from the predictions (len(rows), windows, states) closest to 0.2 s after the start."""
    seconds = np.array([np.median(windows.clock[at] - windows.clock[windows.start]) for at in rows])
    index = int(np.argmin(np.abs(seconds - SHORT)))
    at = rows[index]
    elapsed = windows.clock[at] - windows.clock[windows.start]
    rates = -prediction_errors(windows, at, predicted[index]) / elapsed[:, None]
    values = np.concatenate([windows.states[windows.start], windows.actions[windows.start]], axis=1)
    return Residuals(float(seconds[index]), rates, values)


EVERY = 0.1
"""Time between the starts of two windows [s]."""

MOST_WINDOWS = 100_000
"""Largest number of windows; in longer recordings they start further apart, which does not change the result."""

HORIZONS = 10
"""Number of equal parts of the horizon at which the error is computed."""

PREDICTORS = ("model", "no_change", "constant_velocity")


@dataclass(frozen=True)
class HorizonError:
    """Errors of every predictor after ``seconds``, by predictor's name, on the scale of that horizon."""

    seconds: float
    errors: dict[str, RolloutError]


@dataclass(frozen=True)
class PerRunError:
    """What one run contributes; its error is on the scale of all runs."""

    name: str
    rows: int
    duration: float
    """Length of the run [s]."""
    period: float
    """Median time between rows [s]."""
    stretches: int
    windows: int
    error: float
    per_state: dict[str, float]
    """Scaled error of each state that changed."""
    no_change: dict[str, float]
    """Scaled error of predicting no change, by state."""


@dataclass(frozen=True, repr=False)
class Comparison:
    """The result of a comparison."""

    model: PhysicsModel
    windows: Windows
    horizons: tuple[HorizonError, ...]
    """Shortest first; the last is the requested horizon."""
    predicted: FloatArray
    """Predicted states at the ends of the windows, (windows, states)."""
    errors: FloatArray
    """predicted - measured at the ends of the windows, with angle differences wrapped, (windows, states)."""
    factors: tuple[Factor, ...]
    cells: tuple[Cell, ...]
    residuals: Residuals
    runs: tuple[PerRunError, ...]
    findings: tuple[tuple[str, Finding], ...]
    """(name of the run, finding) pairs."""

    def __repr__(self) -> str:
        facts = {"robot": self.model.system.name, "error": f"{self.error.value:.3g}", "horizon": f"{self.horizon:g} s"}
        return one_line("Comparison", {**facts, "runs": len(self.runs), "windows": len(self.windows)})

    @property
    def error(self) -> RolloutError:
        """The model's error at the horizon."""
        return self.horizons[-1].errors["model"]

    @property
    def horizon(self) -> float:
        """The horizon [s]."""
        return self.windows.horizon

    @property
    def window_errors(self) -> NDArray[np.float64]:
        """Scaled error of each window at its end, root mean square over the states, (windows,)."""
        return window_errors(self.errors, self.error.scale)


def compare_model(
    model: PhysicsModel, runs: Sequence[Run], horizon: float = 1.0, *, every: float = EVERY
) -> Comparison:
    """Rolls the model out from every ``every`` [s] of the runs and computes where it fails.

    At most 100,000 windows are used, evenly spread; a finding reports it. A recording given twice counts once, which is
    reported too.

    Raises InputError for an unusable horizon or a model of another robot, RunError for unusable runs.
    """
    runs, repeated = without_duplicates(runs)
    spread = max(every, sum(run.duration for run in runs) / MOST_WINDOWS)
    windows = windows_of(runs, horizon, every=spread)
    parts = _parts(windows)
    rows = [windows.rows_after(seconds) for seconds in parts[:-1]] + [windows.end]
    rolled = rollout_at(model, windows, rows)
    by_horizon = tuple(
        HorizonError(seconds, _errors(windows, at, predicted))
        for seconds, at, predicted in zip(parts, rows, rolled, strict=True)
    )
    errors = prediction_errors(windows, windows.end, rolled[-1])
    scale = by_horizon[-1].errors["model"].scale
    return Comparison(
        model=model,
        windows=windows,
        horizons=by_horizon,
        predicted=rolled[-1],
        errors=errors,
        factors=factors(windows, errors, scale),
        cells=cells(windows, errors, scale),
        residuals=residuals(windows, rows, rolled),
        runs=_by_run(runs, windows, errors, scale),
        findings=(*_findings(runs, windows, errors, scale), *repeated, *_thinned(every, spread)),
    )


def _parts(windows: Windows) -> list[float]:
    """Returns the ends of equal parts of the horizon [s], at most one per row; the last is the horizon."""
    count = int(min(HORIZONS, max(1, np.median(windows.steps))))
    return [windows.horizon * (index + 1) / count for index in range(count)]


def _errors(windows: Windows, rows: IndexArray, predicted: FloatArray) -> dict[str, RolloutError]:
    return {
        "model": error_of(windows, rows, predicted),
        "no_change": error_of(windows, rows, no_change(windows, rows)),
        "constant_velocity": error_of(windows, rows, constant_velocity(windows, rows)),
    }


def _by_run(runs: Sequence[Run], windows: Windows, errors: FloatArray, scale: FloatArray) -> tuple[PerRunError, ...]:
    found = []
    unchanged = prediction_errors(windows, windows.end, no_change(windows, windows.end))
    for index, run in enumerate(runs):
        inside = windows.run == index
        error = scaled_error(trimmed_rms(errors[inside]), scale) if inside.any() else None
        value = float("nan") if error is None else error.value
        parts = [_named(windows, part[inside], scale) for part in (errors, unchanged)]
        rows = sum(len(part) for part in run.stretches)
        stretches = len(run.stretches)
        found.append(PerRunError(run.name, rows, run.duration, run.period, stretches, int(inside.sum()), value, *parts))
    return tuple(found)


def _named(windows: Windows, errors: FloatArray, scale: FloatArray) -> dict[str, float]:
    """Returns the scaled errors of the states that changed, by name."""
    if not len(errors):
        return {}
    per_state = scaled_error(trimmed_rms(errors), scale).per_state
    names = windows.system.state_names
    return {name: float(value) for name, value in zip(names, per_state, strict=True) if not np.isnan(value)}


def _findings(
    runs: Sequence[Run], windows: Windows, errors: FloatArray, scale: FloatArray
) -> tuple[tuple[str, Finding], ...]:
    found = [(run.name, finding) for run in runs for finding in run.findings]
    for index, run in enumerate(runs):
        members = windows.run == index
        found += [(run.name, finding) for finding in _run_findings(run, windows, members, errors)]
    constant = [v.name for v, size in zip(windows.system.state, scale, strict=True) if not size > 0]
    if constant:
        message = f"{', '.join(constant)} never changed over the horizon; left out of the error"
        found.append(("all", Finding("constant_state", message, len(constant))))
    return tuple(found)


def _thinned(wanted: float, spread: float) -> list[tuple[str, Finding]]:
    if spread <= wanted:
        return []
    message = f"long logs: predictions start every {spread:.3g} s instead of every {wanted:g} s"
    return [("all", Finding("thinned", message))]


def _run_findings(run: Run, windows: Windows, members: NDArray[np.bool_], errors: FloatArray) -> list[Finding]:
    found = []
    if not members.any():
        message = f"no stretch lasts the horizon of {windows.horizon:g} s; the run was not used"
        found.append(Finding("too_short", message))
    elif not np.isfinite(errors[members]).all():
        diverged = ~np.isfinite(errors[members]).all(axis=1)
        message = f"the model's prediction diverges in {int(diverged.sum())} of {int(members.sum())} windows"
        found.append(
            Finding("diverged", message, int(diverged.sum()), float(windows.t[windows.start[members][diverged][0]]))
        )
    steps = np.concatenate([np.diff(t) for t, _, _ in run.parts() if len(t) > 1])
    spread = float(np.quantile(np.abs(steps - run.period), 0.95)) / run.period
    # Below 20 % the spacing is jitter of the recorder; above it derivatives from neighbouring rows become unreliable.
    if spread > 0.2:
        message = (
            f"rows are spaced unevenly: 5 % of the periods differ by more than {spread:.0%} from the median of "
            f"{run.period:.4g} s; each prediction uses the measured periods"
        )
        found.append(Finding("irregular_sampling", message))
    return found


def with_distinct_names(runs: Sequence[Run], paths: Sequence[str | Path]) -> list[Run]:
    """Names the runs after their files, with as many parent folders as make the names distinct.

    A last part that all share (``data_measured`` in separate folders) is dropped.
    """
    parts = [Path(path).absolute().with_suffix("").parts for path in paths]
    depth = 1
    while depth < max(map(len, parts)) and len({part[-depth:] for part in parts}) < len(parts):
        depth += 1
    names = [part[-depth:] for part in parts]
    while all(len(name) > 1 and name[-1] == names[0][-1] for name in names):
        names = [name[:-1] for name in names]
    return [replace(run, name=readable("/".join(name))) for run, name in zip(runs, names, strict=True)]
