"""A model compared with measurements: what ``safedpa compare`` prints and draws, as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.excerpt import without_duplicates
from safedpa.comparison.naive import constant_velocity, no_change
from safedpa.comparison.rollout import rollout_at
from safedpa.comparison.rollout_error import RolloutError, error_of, prediction_errors, scaled_error, trimmed_rms
from safedpa.comparison.where import Cell, Factor, cells, factors, window_errors
from safedpa.comparison.windows import Windows, windows_of
from safedpa.dynamics import PhysicsModel
from safedpa.limits import readable
from safedpa.records.run import Finding, Run

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
"""s; long enough that noise of the measurement averages out, short enough that errors do not mix."""


@dataclass(frozen=True)
class Residuals:
    """rates (windows, states): (measured - predicted) / seconds, in the state's unit per second.

    ``values`` (windows, variables) are the measured states, then the actions, at the windows' starts.
    """

    seconds: float
    rates: FloatArray
    values: FloatArray


def residuals(windows: Windows, rows: Sequence[IndexArray], predicted: FloatArray) -> Residuals:
    """From predictions (len(rows), windows, states) at the rows: those that come nearest to 0.2 s after the start."""
    seconds = np.array([np.median(windows.clock[at] - windows.clock[windows.start]) for at in rows])
    index = int(np.argmin(np.abs(seconds - SHORT)))
    at = rows[index]
    elapsed = windows.clock[at] - windows.clock[windows.start]
    rates = -prediction_errors(windows, at, predicted[index]) / elapsed[:, None]
    values = np.concatenate([windows.states[windows.start], windows.actions[windows.start]], axis=1)
    return Residuals(float(seconds[index]), rates, values)


EVERY = 0.1
"""s; between the starts of two windows."""

MOST_WINDOWS = 100_000
"""Of days of logs windows start farther apart: more would make no number clearer."""

HORIZONS = 10
"""At how many parts of the horizon the error is looked at."""

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
    """s"""
    period: float
    """s"""
    stretches: int
    windows: int
    error: float
    per_state: dict[str, float]
    """Scaled error of each state that changed."""
    no_change: dict[str, float]
    """What "no change" earns there, by state."""


@dataclass(frozen=True)
class Comparison:
    """Everything that a comparison found."""

    model: PhysicsModel
    windows: Windows
    horizons: tuple[HorizonError, ...]
    """Shortest first; the last one is the horizon that was asked for."""
    predicted: FloatArray
    """States at the windows' ends, (windows, states)."""
    errors: FloatArray
    """predicted - measured there, angles by the short way round."""
    factors: tuple[Factor, ...]
    cells: tuple[Cell, ...]
    residuals: Residuals
    runs: tuple[PerRunError, ...]
    findings: tuple[tuple[str, Finding], ...]
    """(name of the run, what was found)"""

    @property
    def error(self) -> RolloutError:
        """The model's error at the horizon."""
        return self.horizons[-1].errors["model"]

    @property
    def horizon(self) -> float:
        """s"""
        return self.windows.horizon

    @property
    def window_errors(self) -> NDArray[np.float64]:
        """Scaled error of each window at its end, root mean square over the states, shape (windows,)."""
        return window_errors(self.errors, self.error.scale)


def compare_model(
    model: PhysicsModel, runs: Sequence[Run], horizon: float = 1.0, *, every: float = EVERY
) -> Comparison:
    """Rolls the model out from every ``every`` seconds of the runs and says where it fails.

    Of more than 100,000 windows so many are kept, evenly spread, and a finding says so; so it is of a recording that is
    given twice, which counts once.

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
    """The horizon in equal parts, as far as there are rows for them; the last is the horizon."""
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
    still = prediction_errors(windows, windows.end, no_change(windows, windows.end))
    for index, run in enumerate(runs):
        own = windows.run == index
        error = scaled_error(trimmed_rms(errors[own]), scale) if own.any() else None
        value = float("nan") if error is None else error.value
        parts = [_named(windows, part[own], scale) for part in (errors, still)]
        rows = sum(len(part) for part in run.stretches)
        stretches = len(run.stretches)
        found.append(PerRunError(run.name, rows, run.duration, run.period, stretches, int(own.sum()), value, *parts))
    return tuple(found)


def _named(windows: Windows, errors: FloatArray, scale: FloatArray) -> dict[str, float]:
    """Scaled errors by state, of those that changed."""
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
        own = windows.run == index
        found += [(run.name, finding) for finding in _own_findings(run, windows, own, errors)]
    still = [v.name for v, size in zip(windows.system.state, scale, strict=True) if not size > 0]
    if still:
        message = f"{', '.join(still)} never changed over the horizon; left out of the error"
        found.append(("all", Finding("constant_state", message, len(still))))
    return tuple(found)


def _thinned(wanted: float, spread: float) -> list[tuple[str, Finding]]:
    if spread <= wanted:
        return []
    message = f"long logs: predictions start every {spread:.3g} s instead of every {wanted:g} s"
    return [("all", Finding("thinned", message))]


def _own_findings(run: Run, windows: Windows, own: NDArray[np.bool_], errors: FloatArray) -> list[Finding]:
    found = []
    if not own.any():
        message = f"no stretch lasts the horizon of {windows.horizon:g} s; the run was not used"
        found.append(Finding("too_short", message))
    elif not np.isfinite(errors[own]).all():
        lost = ~np.isfinite(errors[own]).all(axis=1)
        message = f"the model's prediction grows without bound in {int(lost.sum())} of {int(own.sum())} windows"
        found.append(Finding("diverged", message, int(lost.sum()), float(windows.t[windows.start[own][lost][0]])))
    steps = np.concatenate([np.diff(t) for t, _, _ in run.parts() if len(t) > 1])
    spread = float(np.quantile(np.abs(steps - run.period), 0.95)) / run.period
    if spread > 0.2:
        message = (
            f"rows are spaced unevenly: 5 % of the periods differ by more than {spread:.0%} from the median of "
            f"{run.period:.4g} s; each prediction steps with the period that was measured"
        )
        found.append(Finding("irregular_sampling", message))
    return found


def with_distinct_names(runs: Sequence[Run], paths: Sequence[str | Path]) -> list[Run]:
    """The runs named by their files, with the folders above where it takes them to tell the runs apart.

    A last part that all share (``data_measured`` in a folder each) is left out.
    """
    parts = [Path(path).absolute().with_suffix("").parts for path in paths]
    depth = 1
    while depth < max(map(len, parts)) and len({part[-depth:] for part in parts}) < len(parts):
        depth += 1
    names = [part[-depth:] for part in parts]
    while all(len(name) > 1 and name[-1] == names[0][-1] for name in names):
        names = [name[:-1] for name in names]
    return [replace(run, name=readable("/".join(name))) for run, name in zip(runs, names, strict=True)]
