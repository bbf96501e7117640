"""Adequacy: whether what a model leaves of unseen data is noise and disturbance, or depends on what was driven.

Measurement noise and a disturbance from outside do not depend on state, action, time or history. So two regressions
are tried on unseen folds:

- of the missing rates on powers, products and piecewise linear functions of every state and action, on past actions,
  and on the time, all together, with a ridge penalty;
- of the size of the residual of each window on the sizes of the states and actions in it: what grows with the command
  is no disturbance from outside, even if its mean is 0.

``noise_share`` is the share of the residual's squares that measurement noise explains. The noise is estimated from
third differences of the measured states, which contain hardly any motion.

Source: Hoerl and Kennard, Technometrics 12, 1970 (ridge regression); Billings and Voon, International Journal of
Control 44, 1986 (tests of residuals against all functions of past inputs and outputs); Breusch and Pagan, Econometrica
47, 1979 (variance that depends on regressors).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.where import POSITION
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial
from safedpa.diagnosis.residuals.weak_sindy import (
    HasValues,
    PastAction,
    Regression,
    regression_of,
    terms_of,
    usual_sizes,
)

# Penalties that are compared, relative to the mean curvature of the columns.
_PENALTIES = (3e-3, 3e-2, 0.3)
# Fewer windows leave no fold to fit hundreds of terms in.
_MIN_WINDOWS = 12
# Ages of past actions, in lengths of a window.
_AGES = (0.1, 0.25, 0.5, 1.0, 2.0)
# Windows in a third of all that are compared, and multiples of the median at which their squares are clipped.
_MIN_THIRD, _CLIPPED = 5, 20.0
# Weights of a third difference, and the sum of their squares.
_DIFFERENCE, _SQUARES = np.array([1.0, -3.0, 3.0, -1.0]), 20.0


@dataclass(frozen=True)
class Adequacy:
    """How much of the residual of a model depends on what was driven, on unseen folds."""

    share: float
    """Share of the residual's squares (noise included) that a function of state, action, history and time predicts."""
    standard_errors: float
    """Gain of that function in standard errors over independent blocks."""
    spread: float
    """Largest ratio of the residual's mean squares in windows with large and small states or actions."""
    spread_of: str
    """The variable that orders the windows for ``spread``."""
    spread_errors: float
    """Difference of these mean squares, in standard errors."""
    noise_share: float
    """Share of the squares that the measurement noise explains, 0 to 1."""


def adequacy_of(trial: EffectTrial, shooting: Shooting, states: Sequence[str]) -> Adequacy | None:
    """Returns the adequacy of a fitted model, whose rates of ``states`` may be incomplete; None for too few windows."""
    if len(shooting.windows) < _MIN_WINDOWS or len(np.unique(shooting.fold)) < 2:
        return None
    terms: list[HasValues] = [*terms_of(shooting.windows.system, usual_sizes(shooting)), *_past_actions(shooting)]
    problem = regression_of(trial, shooting, states, terms)
    now, ridge = problem.unseen([]), _Ridge(problem)
    remaining = min((ridge.unseen(penalty) for penalty in _PENALTIES), key=lambda squares: float(squares.sum()))
    share = 1.0 - float(remaining.sum() / max(now.sum(), 1e-300))
    spread, name, errors = _spread(trial, shooting)
    return Adequacy(share, problem.block_gain(now, remaining), spread, name, errors, noise_share(trial, shooting))


def _past_actions(shooting: Shooting) -> list[PastAction]:
    steps = float(np.median(shooting.windows.steps))
    rows = sorted({max(1, round(age * steps)) for age in _AGES})
    return [PastAction(name, count) for name in shooting.windows.system.action_names for count in rows]


@dataclass(frozen=True)
class _Ridge:
    """Ridge regression on the columns of a regression, without a penalty on those that are always included."""

    problem: Regression

    @cached_property
    def _scaled(self) -> tuple[FloatArray, FloatArray]:
        """Returns the products over all windows but those of each fold, with unit diagonals, and the sizes."""
        size = np.sqrt(np.maximum(np.diag(self.problem.whole), 1e-300))
        size[-1] = 1.0
        return (self.problem.whole - self.problem.grams) / np.outer(size, size), size

    def unseen(self, penalty: float) -> FloatArray:
        """Returns the squares (windows,) with coefficients fitted without the window's fold."""
        problem = self.problem
        grams, size = self._scaled
        square, right = grams[:, :-1, :-1], grams[:, :-1, -1]
        weights = np.where(np.arange(square.shape[-1]) < problem.always, 1e-9, penalty)
        values = -np.linalg.solve(square + np.diag(weights), right[..., None])[..., 0] / size[:-1]
        values = values[np.unique(problem.fold, return_inverse=True)[1]]
        remaining = problem.residual + (problem.columns @ values[..., None])[..., 0]
        return np.asarray((remaining**2).sum(axis=1))


def _spread(trial: EffectTrial, shooting: Shooting) -> tuple[float, str, float]:
    """Returns ratio, variable and standard errors of the largest dependence of the residual's size; see Adequacy."""
    squares = (trial.heldout / trial.fit.scale**2).sum(axis=1)
    # A few disturbed windows must not decide.
    squares = np.minimum(squares, _CLIPPED * np.median(squares) + 1e-12)
    found = [(1.0, "", 0.0)]
    for name, values in _sizes_in_windows(shooting).items():
        low, high = np.quantile(values, [1.0 / 3.0, 2.0 / 3.0])
        small, large = squares[values <= low], squares[values >= high]
        if not high > low or min(len(small), len(large)) < _MIN_THIRD:
            continue
        error = np.sqrt(small.var(ddof=1) / len(small) + large.var(ddof=1) / len(large))
        difference = float(large.mean() - small.mean())
        ratio = float(max(large.mean(), small.mean()) / max(min(large.mean(), small.mean()), 1e-12))
        found.append((ratio, name, abs(difference) / max(float(error), 1e-12)))
    return max(found, key=lambda item: item[2])


def _sizes_in_windows(shooting: Shooting) -> dict[str, FloatArray]:
    """Returns the mean size of each state and action in each window, and the variation of each action, by name."""
    windows = shooting.windows
    rows = np.minimum(windows.start[:, None] + shooting.rows, windows.end[:, None] - 1)
    states, actions = windows.states[rows], windows.actions[rows]
    found = {}
    for index, variable in enumerate(windows.system.state):
        if variable.name not in POSITION and not variable.angle:
            found[variable.name] = np.abs(states[..., index]).mean(axis=1)
    for index, variable in enumerate(windows.system.action):
        found[variable.name] = np.abs(actions[..., index]).mean(axis=1)
        found[f"change of {variable.name}"] = actions[..., index].std(axis=1)
    return found


def noise_share(trial: EffectTrial, shooting: Shooting) -> float:
    """Returns the share of the residual's squares that measurement noise explains, as the mean over the states."""
    windows = shooting.windows
    found = []
    for index, size in enumerate(trial.fit.scale):
        parts = [windows.states[begin:stop, index] for begin, stop in windows.bounds.tolist() if stop - begin > 4]
        if parts:
            differences = np.concatenate([np.convolve(part, _DIFFERENCE, mode="valid") for part in parts])
            # The median ignores glitches and steps; 0.6745 relates it to the deviation of Gaussian noise.
            noise = float(np.median(np.abs(differences))) / 0.6745 / np.sqrt(_SQUARES)
            found.append(min(1.0, (noise / max(float(size), 1e-12)) ** 2))
    return float(np.mean(found)) if found else 0.0
