"""Missing rates: the constant rate that each window lacks, and its map over two variables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.where import POSITION
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.residual_inputs import residual_inputs
from safedpa.diagnosis.fit.trial import EffectTrial
from safedpa.diagnosis.report_schema import RateMap
from safedpa.diagnosis.residuals.weak_sindy import TIME
from safedpa.diagnosis.search.regions import clip_outliers
from safedpa.systems import System

# Cells along each side of a map: finer ones would hold too few windows for a mean.
_CELLS = 10
# Windows in a cell that is shown: a mean of one or two windows is mostly noise.
_MIN_WINDOWS = 3


def rate_states(system: System) -> tuple[str, ...]:
    """Returns the states whose rates may be incomplete: the last two that are not positions (velocities come last)."""
    return tuple(name for name in system.state_names if name not in POSITION)[-2:]


def remaining_rates(trial: EffectTrial, shooting: Shooting) -> FloatArray:
    """Returns the constant rate that each window lacks, (windows, rate states), with outliers clipped."""
    return clip_outliers(residual_inputs(trial, shooting, rate_states(shooting.windows.system)))


def variables_of(shooting: Shooting) -> dict[str, FloatArray]:
    """Returns the variables on which a rate may depend, (windows,) by name.

    States are taken at the middle of a window, actions as its mean, and time at its start.
    """
    windows, middle = shooting.windows, shooting.measured.shape[1] // 2
    found: dict[str, FloatArray] = {}
    for index, variable in enumerate(windows.system.state):
        values = shooting.measured[:, middle, index]
        found[variable.name] = (values + np.pi) % (2 * np.pi) - np.pi if variable.angle else values
    for index, variable in enumerate(windows.system.action):
        sums = np.concatenate([[0.0], np.cumsum(windows.actions[:, index])])
        found[variable.name] = (sums[windows.end] - sums[windows.start]) / windows.steps
    found[TIME] = windows.time[windows.start]
    return found


def map_of(across: str, up: str, state: str, rates: FloatArray, shooting: Shooting) -> RateMap:
    """Returns the mean missing rate of a state in cells of two variables."""
    variables, units = variables_of(shooting), units_of(shooting.windows.system)
    state_rates = rates[:, rate_states(shooting.windows.system).index(state)]
    edges, at = [], []
    for name in (across, up):
        # Quantiles, so that one outlier does not squeeze the map into a few cells.
        low, high = np.quantile(variables[name], [0.01, 0.99])
        edges.append(np.linspace(low, max(high, low + 1e-9), _CELLS + 1))
        at.append(np.clip(np.searchsorted(edges[-1], variables[name], side="right") - 1, 0, _CELLS - 1))
    cell = at[1] * _CELLS + at[0]
    counts = np.bincount(cell, minlength=_CELLS**2)
    sums = np.bincount(cell, state_rates, minlength=_CELLS**2)
    means = np.where(counts >= _MIN_WINDOWS, sums / np.maximum(counts, 1), np.nan).reshape(_CELLS, _CELLS)
    rows = tuple(tuple(None if np.isnan(value) else float(value) for value in row) for row in means)
    shape = tuple(tuple(int(count) for count in row) for row in counts.reshape(_CELLS, _CELLS))
    rate_unit = rate_unit_of(shooting.windows.system, state)
    sides: Sequence[tuple[float, ...]] = [tuple(float(value) for value in edge) for edge in edges]
    return RateMap(across, units[across], up, units[up], state, rate_unit, sides[0], sides[1], rows, shape)


def rate_unit_of(system: System, state: str) -> str:
    """Returns the unit of d(state)/dt: m/s becomes m/s2."""
    unit = units_of(system)[state]
    return f"{unit}2" if unit.endswith("/s") else "1/s" if unit == "1" else f"{unit}/s"


def units_of(system: System) -> Mapping[str, str]:
    """Returns the units of states, actions and time by name."""
    return {TIME: "s", **{item.name: item.unit for item in (*system.state, *system.action)}}
