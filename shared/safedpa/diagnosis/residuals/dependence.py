"""Dependence of the residual on one variable: a piecewise linear function, by regression in weak form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial
from safedpa.diagnosis.report_schema import Dependence, Profile
from safedpa.diagnosis.residuals.rates import rate_states, rate_unit_of, units_of, variables_of
from safedpa.diagnosis.residuals.weak_sindy import Regression, regression_of
from safedpa.effects.effect import Named
from safedpa.operations import Operations, Scalar

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
