"""Missing rates and their maps; dependence on one variable: a piecewise linear function, by regression in weak form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.where import POSITION
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial
from safedpa.diagnosis.report_schema import Dependence, Profile, RateMap
from safedpa.diagnosis.residuals.weak_sindy import TIME, Regression, regression_of
from safedpa.diagnosis.search.regions import clip_outliers, residual_inputs
from safedpa.dynamics import PhysicsModel
from safedpa.effects.effect import Named
from safedpa.operations import FLOATS, Operations, Scalar
from safedpa.systems import System

# Cells along each side of a map: finer ones would hold too few windows for a mean.
_CELLS = 10
# Windows in a cell that is shown: a mean of one or two windows is mostly noise.
_MIN_WINDOWS = 3


def rate_states(system: System) -> tuple[str, ...]:
    """Returns the states whose rates may be incomplete: the last two that are not positions (velocities come last)."""
    return tuple(name for name in system.state_names if name not in POSITION)[-2:]


def forced_states(model: PhysicsModel) -> tuple[str, ...]:
    """Returns the states whose rates forces change: not positions, nor states whose rate is another state."""
    system, random = model.system, np.random.default_rng(1)
    low, high = (np.array([getattr(item, end) for item in system.state]) for end in ("low", "high"))
    middle = np.clip(random.uniform(0.1, 0.9, len(low)), low, high)
    state = dict(zip(system.state_names, middle.tolist(), strict=True))
    action = {item.name: float(np.clip(0.37, item.low, item.high)) for item in system.action}
    values = {item.name: model.settings[f"base.{item.name}"].value for item in model.base.parameters}
    rates = model.base.rates(state, action, values, FLOATS)
    others = set(state.values())
    return tuple(name for name in system.state_names if name not in POSITION and rates[name] not in others)


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


# Enough for a curve with two bends, few enough that each knot has data in a minute of driving.
_KNOTS = 13


@dataclass(frozen=True)
class _HatFunction:
    """Linear B-spline: 1 at a knot, 0 at its neighbours, constant beyond the outer knots."""

    variable: str
    knots: FloatArray
    index: int
    angle: bool

    def value(self, named: Named, operations: Operations) -> Scalar:
        del operations
        values = np.asarray(named[self.variable], dtype=np.float64)
        values = (values + np.pi) % (2 * np.pi) - np.pi if self.angle else values
        # Beyond the outer knots the function is constant: there are no data for a slope.
        return np.interp(values, self.knots, np.eye(len(self.knots))[self.index])


@dataclass(frozen=True)
class Dependences:
    """The dependences of all rates on all variables, the strongest first, and the fitted functions."""

    found: tuple[Dependence, ...]
    unseen: dict[tuple[str, str], FloatArray]
    """Squares (windows,) with the function of a (variable, state) that was fitted without the window's fold."""
    problem: Regression
    chosen: dict[tuple[str, str], list[int]]
    knots: dict[str, FloatArray]
    scale: FloatArray
    """Scale of the residual, in the states' units, (states,)."""

    def values(self, variable: str, state: str) -> tuple[FloatArray, FloatArray]:
        """Returns the function at its knots, and standard deviations by a jackknife over the folds."""
        chosen = self.chosen[variable, state]
        # One estimate without each fold; their spread is the jackknife.
        parts = self.problem.solve(chosen, self.problem.whole - self.problem.grams)[:, self.problem.always :]
        spread = np.sqrt((len(parts) - 1) * np.var(parts, axis=0))
        return self.problem.coefficients(chosen), spread


def dependences_of(trial: EffectTrial, shooting: Shooting) -> Dependences:
    """Computes how well a function of each variable predicts the residual of a fitted model on unseen blocks."""
    system = shooting.windows.system
    angles = {item.name for item in system.state if item.angle}
    knots = {name: _knots(values, name in angles) for name, values in variables_of(shooting).items()}
    # Two knots are a straight line, which the free parameters usually contain.
    knots = {name: positions for name, positions in knots.items() if len(positions) > 2}
    hats = [_HatFunction(name, at, index, name in angles) for name, at in knots.items() for index in range(len(at))]
    states = rate_states(system)
    problem = regression_of(trial, shooting, states, hats)
    # Every variable is compared with the same null: free parameters only.
    now = problem.unseen([])
    found, unseen, chosen = [], {}, {}
    for row, state in enumerate(states):
        for name in knots:
            columns = [i for i, hat in enumerate(hats) if hat.variable == name]
            chosen[name, state] = [row * len(hats) + i for i in columns]
            remaining = unseen[name, state] = problem.unseen(chosen[name, state])
            share = 1.0 - float(remaining.sum() / max(now.sum(), 1e-300))
            found.append(Dependence(name, state, share, problem.block_gain(now, remaining)))
    order = tuple(sorted(found, key=lambda item: -item.share))
    return Dependences(order, unseen, problem, chosen, knots, trial.fit.scale)


def profile_of(
    dependences: Dependences, variable: str, state: str, formula: Sequence[float] | None, shooting: Shooting
) -> Profile:
    """Returns the function of one variable that a state's rate lacks, with the formula's values at its knots."""
    values, errors = dependences.values(variable, state)
    system = shooting.windows.system
    return Profile(
        variable,
        units_of(system)[variable],
        state,
        rate_unit_of(system, state),
        tuple(dependences.knots[variable].tolist()),
        tuple(values.tolist()),
        tuple(errors.tolist()),
        None if formula is None else tuple(float(value) for value in formula),
        _rows_about(dependences.knots[variable], variable, shooting),
    )


def _rows_about(knots: FloatArray, variable: str, shooting: Shooting) -> tuple[int, ...]:
    """Returns how many measured rows are closest to each knot, at most half a step outside the outer knots."""
    windows = shooting.windows
    names = (*windows.system.state_names, *windows.system.action_names)
    if variable in names:
        values = np.concatenate([windows.states, windows.actions], axis=1)[:, names.index(variable)]
    else:
        values = windows.time
    if variable in {item.name for item in windows.system.state if item.angle}:
        values = (values + np.pi) % (2 * np.pi) - np.pi
    middles = 0.5 * (knots[1:] + knots[:-1])
    ends = (2.0 * knots[0] - middles[0], 2.0 * knots[-1] - middles[-1])
    return tuple(np.histogram(values, np.concatenate([ends[:1], middles, ends[1:]]))[0].tolist())


def _knots(values: FloatArray, angle: bool) -> FloatArray:
    """Returns knots halfway between equal steps and equal shares of the data, so that both are covered."""
    if angle:
        return np.linspace(-np.pi, np.pi, _KNOTS)
    low, high = np.quantile(values, [0.02, 0.98])
    if not high - low > 1e-9:
        return np.zeros(0)
    even = np.linspace(low, high, _KNOTS)
    shares = np.quantile(values, np.linspace(0.02, 0.98, _KNOTS))
    return np.unique(0.5 * (even + shares))
