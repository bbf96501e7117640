"""Sparse regression in weak form: the short formula whose integrals explain the residuals of short rollouts.

To first order a rate c phi(x, a) beside a model adds

    delta(t) = c T(t) integral from 0 to t of T(s)^-1 e phi(s) ds,

to its prediction, where T(t) is the derivative of the prediction with respect to its start and e the state whose rate
it is: integrals of what was measured, no derivative of it. Terms join one by one while unseen blocks confirm them.

Source: Messenger and Bortz, Weak SINDy, Multiscale Modeling and Simulation 19(3), 2021; forward selection as in
Miller, Subset Selection in Regression, 2nd ed., 2002, ch. 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from safedpa.compare.rollout import felt_actions
from safedpa.compare.windows import Floats, Rows
from safedpa.diagnosis.fit.shooting import Shooting
from safedpa.diagnosis.fit.trial import Trial
from safedpa.diagnosis.remains.terms import TIME, Term, terms_of
from safedpa.effects.effect import Named
from safedpa.operations import NUMPY, Operations, Scalar

__all__ = ["Regression", "Selected", "Valued", "regression_of", "selected_terms", "sure_enough"]

SURE = 5.0
"""Standard errors on unseen blocks that the first term needs: hundreds are looked at."""
LARGE = 0.2
"""Share of the squares of unseen blocks with which it may be FEW standard errors: where a few blocks hold all of it,
their differences are as large as their sum."""
FEW = 3.0
"""As many as a named effect needs."""
MORE = 3.0
"""Standard errors that each further term needs."""
_SHARE = 0.02
"""Of the squares of the residual, noise included, that a term has to take off."""
_MOST = 4
"""Terms."""
_LOOKED_AT = 8
"""Terms whose gain on unseen data is worked out at each step."""
_REGULAR = 1e-6
"""Determinant from which a derivative is inverted as it is."""


class Valued(Protocol):
    """Anything with a value for named states, actions and time."""

    def value(self, named: Named, operations: Operations) -> Scalar: ...  # noqa: D102


@dataclass(frozen=True)
class Selected:
    """(state, term) pairs, their coefficients, and terms that are as good as the first."""

    terms: tuple[tuple[str, Term], ...]
    coefficients: Floats
    alternatives: tuple[str, ...]


@dataclass(frozen=True)
class Regression:
    """residual (windows, numbers) + columns (windows, numbers, terms) c = noise; the first ``always`` stay in.

    What is ``chosen`` is counted behind those: 0 is the first column that does not stay in.
    """

    residual: Floats
    columns: Floats
    always: int
    fold: Rows
    block: Rows

    def _index(self, chosen: Sequence[int]) -> list[int]:
        return [*range(self.always), *(self.always + number for number in chosen)]

    @cached_property
    def grams(self) -> Floats:
        """Products of columns and residual with each other, by fold."""
        return np.stack([self._products(self.fold == fold) for fold in np.unique(self.fold)])

    def _products(self, used: NDArray[np.bool_]) -> Floats:
        flat = np.concatenate([self.columns[used], self.residual[used][..., None]], axis=-1)
        flat = flat.reshape(-1, flat.shape[-1])
        return np.asarray(flat.T @ flat, dtype=np.float64)

    @cached_property
    def whole(self) -> Floats:
        """Products of columns and residual with each other, by all windows."""
        return np.asarray(self.grams.sum(axis=0))

    def solved(self, chosen: Sequence[int], grams: Floats) -> Floats:
        """Coefficients (..., always and chosen) of the always-in and the chosen columns by least squares, from products
        (..., columns and residual, columns and residual)."""
        index = self._index(chosen)
        square, right = grams[..., index, :][..., index], grams[..., index, -1]
        # a column that only the fold left out has is rounding here, and counts nothing
        least = 1e-9 * np.diag(self.whole)[index] + 1e-300
        size = np.sqrt(np.maximum(np.diagonal(square, axis1=-2, axis2=-1), least))
        scaled = square / (size[..., :, None] * size[..., None, :])
        inverse = np.linalg.pinv(scaled, rcond=1e-7, hermitian=True)
        return np.asarray(-(inverse @ (right / size)[..., None])[..., 0] / size)

    def coefficients(self, chosen: Sequence[int]) -> Floats:
        """Of the chosen columns, by all windows."""
        return self.solved(chosen, self.whole)[self.always :]

    def unseen(self, chosen: Sequence[int]) -> Floats:
        """Squares (windows,) with coefficients fitted without the window's fold."""
        columns = self.columns[..., self._index(chosen)]
        values = self.solved(chosen, self.whole - self.grams)[np.unique(self.fold, return_inverse=True)[1]]
        left = self.residual + (columns @ values[..., None])[..., 0]
        return np.asarray((left**2).sum(axis=1))

    def falls(self, chosen: Sequence[int]) -> Floats:
        """How much each column takes off the squares beside the chosen ones, to order them by."""
        gram, index = self.whole, self._index(chosen)
        part = np.linalg.pinv(gram[np.ix_(index, index)], rcond=1e-10, hermitian=True) @ gram[index]
        left = gram - gram[index].T @ part
        own = np.diag(left)[:-1]
        usable = own > 1e-6 * np.diag(gram)[:-1]
        return np.asarray(np.where(usable, left[:-1, -1] ** 2 / np.where(usable, own, 1.0), 0.0))[self.always :]

    def sure(self, one: Floats, other: Floats) -> float:
        """Gain of ``other`` over ``one`` in standard errors of independent blocks."""
        difference = one - other
        # no glitch may decide; where few of the windows are concerned, the median knows nothing of them
        size = np.abs(difference)
        most = max(20.0 * float(np.median(size)), 3.0 * float(np.quantile(size, 0.9))) + 1e-12
        sums = np.bincount(self.block, np.clip(difference, -most, most))[np.unique(self.block)]
        if len(sums) < 8:
            return 0.0
        return float(sums.sum() / max(float(sums.std(ddof=1)) * np.sqrt(len(sums)), 1e-300))


def selected_terms(trial: Trial, shooting: Shooting, states: Sequence[str], most: int = _MOST) -> Selected | None:
    """The terms that unseen blocks confirm beside a fitted model, at most ``most``; None where none is."""
    system = shooting.windows.system
    terms = terms_of(system, _sizes(shooting))
    pairs = [(state, term) for state in states for term in terms]
    problem = regression_of(trial, shooting, states, terms)
    chosen, alternatives = _forward(problem, most)
    chosen = _backward(problem, chosen)
    if not chosen:
        return None
    texts = tuple(f"{pairs[i][0]}: {pairs[i][1].text}" for i in alternatives)
    found = tuple(pairs[index] for index in chosen)
    return Selected(found, problem.coefficients(chosen), texts)


def sure_enough(standard_errors: float, share: float) -> bool:
    """Whether what was chosen among hundreds holds: surely, or a large share of the squares of unseen blocks."""
    return (standard_errors > SURE and share > _SHARE) or (standard_errors > FEW and share > LARGE)


def regression_of(trial: Trial, shooting: Shooting, states: Sequence[str], terms: Sequence[Valued]) -> Regression:
    """The regression of a fitted model's residual on rates of ``states``: every term of the first, then of the next."""
    own = trial.fit.columns
    columns = np.concatenate([own, _columns(trial, shooting, states, terms)], axis=-1)
    return Regression(trial.fit.residual, columns, own.shape[-1], shooting.fold, shooting.block)


def _forward(problem: Regression, most: int) -> tuple[list[int], list[int]]:
    chosen: list[int] = []
    alternatives: list[int] = []
    now = problem.unseen(chosen)
    for step in range(most):
        falls = problem.falls(chosen)
        order = [int(index) for index in np.argsort(-falls)[:_LOOKED_AT] if index not in chosen]
        tried = {index: problem.unseen([*chosen, index]) for index in order}
        best = min(order, key=lambda index: float(tried[index].sum()))
        gain, share = problem.sure(now, tried[best]), 1.0 - float(tried[best].sum() / max(now.sum(), 1e-300))
        if not (sure_enough(gain, share) if step == 0 else gain > MORE and share > _SHARE):
            break
        if not step:
            close = [i for i in order if i != best and problem.sure(tried[i], tried[best]) < 1.0]
            alternatives = close[:3]
        chosen.append(best)
        now = tried[best]
    return chosen, alternatives


def _backward(problem: Regression, chosen: list[int]) -> list[int]:
    """Without the terms that the later ones made superfluous."""
    for index in chosen[:-1]:
        if len(chosen) < 2:
            break
        less = [other for other in chosen if other != index]
        if problem.sure(problem.unseen(less), problem.unseen(chosen)) < 2.0:
            chosen = less
    return chosen


def _sizes(shooting: Shooting) -> dict[str, float]:
    """Root mean square of states and actions by name."""
    windows = shooting.windows
    names = (*windows.system.state_names, *windows.system.action_names)
    values = (*windows.states.T, *windows.actions.T)
    return {name: float(np.sqrt(np.mean(column**2))) for name, column in zip(names, values, strict=True)}


def _columns(trial: Trial, shooting: Shooting, states: Sequence[str], terms: Sequence[Valued]) -> Floats:
    """What a coefficient of 1 adds to the reduced residual: (windows, numbers, states * terms)."""
    system = shooting.windows.system
    seconds, values = _integrands(trial, shooting, terms)
    tangent = shooting.tangent
    inverse = _inverses(tangent)
    first, second = (0.5 * seconds[..., None] * end for end in values)
    whole = np.zeros((*tangent.shape[:3], len(states) * len(terms)))
    for number, state in enumerate(states):
        pulled = inverse[..., system.state_names.index(state), None]  # T(s)^-1 e
        steps = pulled[:, :-1] * first[:, :, None]
        steps += pulled[:, 1:] * second[:, :, None]
        sums = np.cumsum(steps, axis=1, out=steps)
        whole[:, 1:, :, number * len(terms) : (number + 1) * len(terms)] = tangent[:, 1:] @ sums
    return shooting.eliminated(whole, trial.fit.scale)


def _inverses(matrices: Floats) -> Floats:
    """Inverses (..., n, n), of directions that are gone none."""
    if (np.abs(np.linalg.det(matrices)) > _REGULAR).all():
        return np.asarray(np.linalg.inv(matrices))
    return np.asarray(np.linalg.pinv(matrices, rcond=1e-9))


def _integrands(trial: Trial, shooting: Shooting, terms: Sequence[Valued]) -> tuple[Floats, tuple[Floats, Floats]]:
    """Seconds of each interval between compared rows, and every term at its two ends: (windows, intervals, terms)."""
    windows, system = shooting.windows, shooting.windows.system
    model = trial.fit.model
    predicted = shooting.residuals([model])[0] + shooting.measured
    states = np.where(shooting.counts > 0, shooting.measured, predicted)
    at = np.minimum(windows.start[:, None] + shooting.rows, windows.end[:, None])
    sums = np.concatenate([np.zeros((1, len(system.action))), np.cumsum(felt_actions(model, windows), axis=0)])
    rows = np.maximum(at[:, 1:] - at[:, :-1], 1)
    means = (sums[np.minimum(at[:, :-1] + rows, len(sums) - 1)] - sums[at[:, :-1]]) / rows[..., None]
    ends = []
    for part, time in ((states[:, :-1], at[:, :-1]), (states[:, 1:], at[:, 1:])):
        named = {name: part[..., index] for index, name in enumerate(system.state_names)}
        named |= {name: means[..., index] for index, name in enumerate(system.action_names)}
        named[TIME] = windows.time[time]
        values = [np.broadcast_to(term.value(named, NUMPY), time.shape) for term in terms]
        ends.append(np.stack(values, axis=-1))
    seconds = np.diff(windows.clock[at], axis=1)
    return seconds, (ends[0], ends[1])
