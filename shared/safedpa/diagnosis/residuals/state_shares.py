"""Shares by state: what depends on the drive in one state is diluted among the squares of all the others.

Two regressions are tried on unseen folds, and judged on the squares of one state at a time:

- of the missing rates on functions of everything measured, with a ridge penalty;
- of one missing rate on a piecewise linear function of one state or action, compared with a straight line: bumps, a
  curve of an actuator, or a force within a narrow range are no power of anything.

Source: Hoerl and Kennard, Technometrics 12, 1970 (ridge regression); Hastie and Tibshirani, Generalized Additive
Models, 1990 (functions of one variable at a time).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.rollout import effective_actions
from safedpa.comparison.where import POSITION
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial
from safedpa.diagnosis.residuals.weak_sindy import Regression, RowTerm, regression_of

__all__ = ["PENALTIES", "RidgeRegression", "StateShare", "largest_state_share"]

PENALTIES = (3e-3, 3e-2, 0.3)
"""Penalties that are compared, relative to the mean curvature of the columns."""
# Knots of a function of one variable.
_KNOTS = 16
# Share of the squares, and standard errors, from which it counts.
_SHARE, _SURE = 0.1, 4.0


@dataclass(frozen=True)
class StateShare:
    """Share of the squares of one state that depends on the drive, and its gain in standard errors."""

    state: str = ""
    """Empty if no state has such a share."""
    share: float = 0.0
    standard_errors: float = 0.0


@dataclass(frozen=True)
class RidgeRegression:
    """Ridge regression on the columns of a regression, without a penalty on those that are always included."""

    problem: Regression

    @cached_property
    def _scaled(self) -> tuple[FloatArray, FloatArray]:
        """Returns the products over all windows but those of each fold, with unit diagonals, and the sizes."""
        size = np.sqrt(np.maximum(np.diag(self.problem.whole), 1e-300))
        size[-1] = 1.0
        return (self.problem.whole - self.problem.grams) / np.outer(size, size), size

    def unseen(self, penalty: float) -> FloatArray:
        """Returns the residual (windows, n) with coefficients fitted without the window's fold."""
        problem = self.problem
        grams, size = self._scaled
        square, right = grams[:, :-1, :-1], grams[:, :-1, -1]
        weights = np.where(np.arange(square.shape[-1]) < problem.always, 1e-9, penalty)
        values = -np.linalg.solve(square + np.diag(weights), right[..., None])[..., 0] / size[:-1]
        values = values[np.unique(problem.fold, return_inverse=True)[1]]
        return np.asarray(problem.residual + (problem.columns @ values[..., None])[..., 0])


def largest_state_share(
    trial: EffectTrial, shooting: Shooting, states: Sequence[str], ridge: RidgeRegression
) -> StateShare:
    """Returns the largest share of the squares of one state that depends on the drive; ``ridge`` is of ``states``."""
    found = [*_by_ridge(shooting, states, ridge), *_by_functions(trial, shooting, states)]
    sure = [item for item in found if item.share > _SHARE and item.standard_errors > _SURE]
    return max(sure, key=lambda item: item.share, default=StateShare())


def _by_ridge(shooting: Shooting, states: Sequence[str], ridge: RidgeRegression) -> Iterator[StateShare]:
    now = ridge.problem.unseen_residual([])
    for penalty in PENALTIES:
        remaining = ridge.unseen(penalty)
        yield from (_share_of(state, shooting, ridge.problem, now, remaining) for state in states)


def _by_functions(trial: EffectTrial, shooting: Shooting, states: Sequence[str]) -> Iterator[StateShare]:
    windows = shooting.windows
    variables = dict(zip(windows.system.state_names, windows.states.T, strict=True))
    actions = effective_actions(trial.fit.model, windows).T
    variables |= dict(zip(windows.system.action_names, actions, strict=True))
    for name, values in variables.items():
        knots = np.unique(np.quantile(values, np.linspace(0.02, 0.98, _KNOTS)))
        if name in POSITION or len(knots) < 3:
            continue
        parts = [values, *(np.interp(values, knots, weights) for weights in np.eye(len(knots)))]
        terms = [RowTerm(f"{name} {index}", part) for index, part in enumerate(parts)]
        for state in states:
            problem = regression_of(trial, shooting, [state], terms)
            line, curve = (problem.unseen_residual(range(count)) for count in (1, len(terms)))
            yield _share_of(state, shooting, problem, line, curve)


def _share_of(state: str, shooting: Shooting, problem: Regression, before: FloatArray, after: FloatArray) -> StateShare:
    """Returns by how much the squares of a state fall from one unseen residual to the other."""
    index = shooting.windows.system.state_names.index(state)
    one, other = (shooting.squares(part)[:, index] for part in (before, after))
    share = 1.0 - float(other.sum() / max(one.sum(), 1e-300))
    return StateShare(state, share, problem.block_gain(one, other))
