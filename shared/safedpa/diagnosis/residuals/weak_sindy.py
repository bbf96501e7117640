"""Sparse regression in weak form: finds the short formula whose integrals explain the residuals of short rollouts.

The terms are powers, absolute values, signs and sines of states and actions, and products of two. To first order a rate
c phi(x, a) that the model lacks adds

    delta(t) = c T(t) integral from 0 to t of T(s)^-1 e phi(s) ds,

to its prediction, where T(t) is the derivative of the prediction with respect to its start and e selects the state with
that rate. So measurements are integrated, never differentiated. Terms are added while unseen blocks confirm them.

Source: Messenger and Bortz, Weak SINDy, Multiscale Modeling and Simulation 19(3), 2021; forward selection as in
Miller, Subset Selection in Regression, 2nd ed., 2002, ch. 3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.rollout import effective_actions
from safedpa.comparison.where import POSITION
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial
from safedpa.effects.effect import Named
from safedpa.operations import NUMPY, Operations, Scalar
from safedpa.systems import System, Variable

TIME = "time"
"""Name of the seconds since the run's start among a term's variables."""

_Function = Callable[[Scalar, float, Operations], Scalar]
"""(value, size near rest, operations) -> value"""

# Share of a variable's usual size below which its sign is smoothed: near rest the sign is that of the noise.
_REST = 0.02

_SHAPES: dict[str, tuple[int, _Function]] = {
    "{0}": (1, lambda v, _r, _o: v),
    "|{0}|": (1, lambda v, _r, o: o.absolute(v)),
    "sign({0})": (0, lambda v, r, o: o.tanh(v / r)),
    "{0}^2": (2, lambda v, _r, _o: v * v),
    "{0} |{0}|": (2, lambda v, _r, o: v * o.absolute(v)),
    "{0}^3": (3, lambda v, _r, _o: v * v * v),
    "sin({0})": (0, lambda v, _r, o: o.sin(v)),
    "cos({0})": (0, lambda v, _r, o: o.cos(v)),
}
"""Text of each shape, and the power of the variable's unit that it has."""

_QUANTITY = ("{0}", "|{0}|", "sign({0})", "{0}^2", "{0} |{0}|", "{0}^3")
_ANGLE = ("sin({0})", "cos({0})")
_ACTION = ("{0}", "|{0}|", "sign({0})", "{0}^2", "{0} |{0}|")
_IN_PRODUCTS = ("{0}", "|{0}|", "sign({0})", "{0}^2", "{0} |{0}|", "sin({0})", "cos({0})")
_FEW_IN_PRODUCTS = ("{0}", "|{0}|", "{0}^2")


@dataclass(frozen=True)
class _Factor:
    variable: str
    unit: str
    shape: str
    rest: float

    def value(self, named: Named, operations: Operations) -> Scalar:
        return _SHAPES[self.shape][1](named[self.variable], self.rest, operations)

    @property
    def units(self) -> list[str]:
        """The unit, repeated by its power; empty for dimensionless ones."""
        return [self.unit] * _SHAPES[self.shape][0] if self.unit not in ("1", "rad") else []


@dataclass(frozen=True)
class Term:
    """A product of at most two factors; the constant 1 without factors."""

    factors: tuple[_Factor, ...]

    @property
    def text(self) -> str:
        """The term as text in a formula."""
        return " ".join(factor.shape.format(factor.variable) for factor in self.factors) or "1"

    @property
    def variables(self) -> tuple[str, ...]:
        """The variables that it depends on, each once."""
        return tuple(dict.fromkeys(factor.variable for factor in self.factors))

    @property
    def units(self) -> list[str]:
        """The units of its value, one by one."""
        return [unit for factor in self.factors for unit in factor.units]

    def value(self, named: Named, operations: Operations) -> Scalar:
        """Returns the value for named states, actions and ``time``."""
        result: Scalar = 1.0
        for factor in self.factors:
            result = result * factor.value(named, operations)
        return result


def terms_of(system: System, sizes: dict[str, float]) -> list[Term]:
    """Returns all terms for a system; ``sizes`` are usual absolute values by variable, which define "near rest"."""

    def factors(variable: Variable, shapes: Sequence[str]) -> list[_Factor]:
        rest_scale = max(_REST * sizes.get(variable.name, 1.0), 1e-6)
        return [_Factor(variable.name, variable.unit, shape, rest_scale) for shape in shapes]

    positions = [item for item in system.state if item.name in POSITION]
    angles = [item for item in system.state if item.angle]
    states = [item for item in system.state if not item.angle and item.name not in POSITION]
    singles = [factor for item in states for factor in factors(item, _QUANTITY)]
    singles += [factor for item in angles for factor in factors(item, _ANGLE)]
    singles += [factor for item in system.action for factor in factors(item, _ACTION)]
    singles += [factor for item in positions for factor in factors(item, ("{0}",))]
    singles += [_Factor(TIME, "s", "{0}", 1.0)]
    found = [Term(()), *(Term((factor,)) for factor in singles)]
    first = [factor for item in [*states, *angles] for factor in singles if factor.variable == item.name]
    second = [factor for item in system.action for factor in singles if factor.variable == item.name]
    # Only physically common products: state with action, state with an angle, and action with action.
    found += _products(first, second)
    found += _products([f for f in first if f.shape in _FEW_IN_PRODUCTS], [f for f in first if f.shape in _ANGLE])
    for index, one in enumerate(system.action):
        for other in system.action[index + 1 :]:
            found += _products(factors(one, _FEW_IN_PRODUCTS), factors(other, _FEW_IN_PRODUCTS))
    return found


def _products(ones: Sequence[_Factor], others: Sequence[_Factor]) -> list[Term]:
    return [
        Term((one, other))
        for one, other in product(ones, others)
        if one.variable != other.variable and one.shape in _IN_PRODUCTS and other.shape in (*_FEW_IN_PRODUCTS, *_ANGLE)
    ]


SURE = 5.0
"""Standard errors on unseen blocks that the first term needs: hundreds of terms are compared."""
LARGE = 0.2
"""Share of the squares of unseen blocks with which FEW standard errors suffice. If a few blocks contain all of an
effect, the differences between blocks are as large as their sum."""
FEW = 3.0
"""Standard errors that suffice with LARGE: as many as a named effect needs."""
MORE = 3.0
"""Standard errors that each further term needs."""
# Share of the squares of the residual (noise included) that a term has to explain: smaller terms may be significant in
# long recordings, but do not matter for predictions.
_MIN_SHARE = 0.02
# Terms of a formula: a longer one is no explanation, and its terms are not unique.
_MAX_TERMS = 4
# Terms whose gain on unseen data is computed at each step, the best on all data first: each needs a regression per
# fold.
_COMPARED = 8
# Determinant below which the pseudo-inverse is used: the inverse of a nearly singular matrix is mostly rounding error.
_REGULAR = 1e-6


class HasValues(Protocol):
    """Anything that has a value for named states, actions and time."""

    def value(self, named: Named, operations: Operations) -> Scalar: ...  # noqa: D102


@dataclass(frozen=True)
class PastAction:
    """An effective action some rows before, as a term: what an actuator with memory depends on."""

    action: str
    rows: int

    def value(self, named: Named, operations: Operations) -> Scalar:
        """Returns the action ``rows`` rows ago."""
        del operations
        return named[self.key]

    @property
    def key(self) -> str:
        """Its name among the values."""
        return f"{self.action} {self.rows} rows ago"


@dataclass(frozen=True, eq=False)
class RowTerm:
    """A term with a known value over the period after each row of the table, such as a filtered action."""

    name: str
    values: FloatArray
    """Shape (rows,)."""

    def value(self, named: Named, operations: Operations) -> Scalar:
        """Returns the mean of the values over an interval."""
        del operations
        return named[self.name]


@dataclass(frozen=True)
class SelectedTerms:
    """(state, term) pairs, their coefficients, and alternatives that are as good as the first term."""

    terms: tuple[tuple[str, Term], ...]
    coefficients: FloatArray
    alternatives: tuple[str, ...]


@dataclass(frozen=True)
class Regression:
    """A regression residual (windows, n) + columns (windows, n, terms) c = noise.

    The first ``always`` columns are always included (the free parameters). Indices in ``chosen`` count from the first
    column behind them.
    """

    residual: FloatArray
    columns: FloatArray
    always: int
    fold: IndexArray
    block: IndexArray

    def _index(self, chosen: Sequence[int]) -> list[int]:
        return [*range(self.always), *(self.always + number for number in chosen)]

    @cached_property
    def grams(self) -> FloatArray:
        """Products of columns and residual with each other, per fold."""
        return np.stack([self._products(self.fold == fold) for fold in np.unique(self.fold)])

    def _products(self, used: NDArray[np.bool_]) -> FloatArray:
        flat = np.concatenate([self.columns[used], self.residual[used][..., None]], axis=-1)
        flat = flat.reshape(-1, flat.shape[-1])
        return np.asarray(flat.T @ flat, dtype=np.float64)

    @cached_property
    def whole(self) -> FloatArray:
        """Products of columns and residual with each other over all windows."""
        return np.asarray(self.grams.sum(axis=0))

    def solve(self, chosen: Sequence[int], grams: FloatArray) -> FloatArray:
        """Returns least-squares coefficients (..., always + chosen) from products (..., columns + 1, columns + 1).

        The last row and column of the products belong to the residual.
        """
        index = self._index(chosen)
        square, right = grams[..., index, :][..., index], grams[..., index, -1]
        # A column that is nonzero only in the left-out fold is rounding here; the floor makes its coefficient 0.
        least = 1e-9 * np.diag(self.whole)[index] + 1e-300
        size = np.sqrt(np.maximum(np.diagonal(square, axis1=-2, axis2=-1), least))
        scaled = square / (size[..., :, None] * size[..., None, :])
        inverse = np.linalg.pinv(scaled, rcond=1e-7, hermitian=True)
        return np.asarray(-(inverse @ (right / size)[..., None])[..., 0] / size)

    def coefficients(self, chosen: Sequence[int]) -> FloatArray:
        """Returns the coefficients of the chosen columns, fitted to all windows."""
        return self.solve(chosen, self.whole)[self.always :]

    def unseen_residual(self, chosen: Sequence[int]) -> FloatArray:
        """Returns the residual (windows, n) with coefficients fitted without the window's fold."""
        columns = self.columns[..., self._index(chosen)]
        values = self.solve(chosen, self.whole - self.grams)[np.unique(self.fold, return_inverse=True)[1]]
        return np.asarray(self.residual + (columns @ values[..., None])[..., 0])

    def unseen(self, chosen: Sequence[int]) -> FloatArray:
        """Returns its squares (windows,)."""
        return np.asarray((self.unseen_residual(chosen) ** 2).sum(axis=1))

    def reductions(self, chosen: Sequence[int]) -> FloatArray:
        """Returns how much each column reduces the squares together with the chosen ones; used only for their order."""
        gram, index = self.whole, self._index(chosen)
        part = np.linalg.pinv(gram[np.ix_(index, index)], rcond=1e-10, hermitian=True) @ gram[index]
        remaining = gram - gram[index].T @ part
        curvature = np.diag(remaining)[:-1]
        # A column nearly spanned by the chosen ones would show a large reduction by rounding.
        usable = curvature > 1e-6 * np.diag(gram)[:-1]
        return np.asarray(np.where(usable, remaining[:-1, -1] ** 2 / np.where(usable, curvature, 1.0), 0.0))[
            self.always :
        ]

    def block_gain(self, one: FloatArray, other: FloatArray) -> float:
        """Returns the gain of ``other`` over ``one`` in standard errors of independent blocks."""
        difference = one - other
        # Clipping keeps one glitch from deciding. The quantile covers structure in few windows, which the median
        # misses.
        size = np.abs(difference)
        most = max(20.0 * float(np.median(size)), 3.0 * float(np.quantile(size, 0.9))) + 1e-12
        sums = np.bincount(self.block, np.clip(difference, -most, most))[np.unique(self.block)]
        # As in trial.standardized_gains: fewer blocks do not show their own spread.
        if len(sums) < 8:
            return 0.0
        return float(sums.sum() / max(float(sums.std(ddof=1)) * np.sqrt(len(sums)), 1e-300))


def selected_terms(
    trial: EffectTrial, shooting: Shooting, states: Sequence[str], most: int = _MAX_TERMS
) -> SelectedTerms | None:
    """Returns at most ``most`` terms that unseen blocks confirm on top of a fitted model; None if there is none."""
    system = shooting.windows.system
    terms = terms_of(system, usual_sizes(shooting))
    pairs = [(state, term) for state in states for term in terms]
    problem = regression_of(trial, shooting, states, terms)
    chosen, alternatives = _forward(problem, most)
    chosen = _backward(problem, chosen)
    if not chosen:
        return None
    texts = tuple(f"{pairs[i][0]}: {pairs[i][1].text}" for i in alternatives)
    found = tuple(pairs[index] for index in chosen)
    return SelectedTerms(found, problem.coefficients(chosen), texts)


def is_significant(standard_errors: float, share: float) -> bool:
    """Returns whether a term chosen among hundreds is significant: clearly, or with a large share of unseen squares."""
    return (standard_errors > SURE and share > _MIN_SHARE) or (standard_errors > FEW and share > LARGE)


def regression_of(
    trial: EffectTrial, shooting: Shooting, states: Sequence[str], terms: Sequence[HasValues]
) -> Regression:
    """Returns the regression of a model's residual on rates of ``states``: all terms of one state, then the next."""
    free_columns = trial.fit.columns
    # The free parameters stay in the regression, so a term is credited only with what they cannot explain.
    columns = np.concatenate([free_columns, _columns(trial, shooting, states, terms)], axis=-1)
    return Regression(trial.fit.residual, columns, free_columns.shape[-1], shooting.fold, shooting.block)


def _forward(problem: Regression, most: int) -> tuple[list[int], list[int]]:
    chosen: list[int] = []
    alternatives: list[int] = []
    now = problem.unseen(chosen)
    for step in range(most):
        reductions = problem.reductions(chosen)
        order = [int(index) for index in np.argsort(-reductions)[:_COMPARED] if index not in chosen]
        tried = {index: problem.unseen([*chosen, index]) for index in order}
        # By unseen squares, not by the reduction that ordered the candidates: that one favours overfitting.
        best = min(order, key=lambda index: float(tried[index].sum()))
        gain, share = problem.block_gain(now, tried[best]), 1.0 - float(tried[best].sum() / max(now.sum(), 1e-300))
        if not (is_significant(gain, share) if step == 0 else gain > MORE and share > _MIN_SHARE):
            break
        if not step:
            # Only the first term has alternatives in the report: later ones depend on its choice.
            close = [i for i in order if i != best and problem.block_gain(tried[i], tried[best]) < 1.0]
            alternatives = close[:3]
        chosen.append(best)
        now = tried[best]
    return chosen, alternatives


def _backward(problem: Regression, chosen: list[int]) -> list[int]:
    """Removes terms that later ones made superfluous."""
    for index in chosen[:-1]:
        if len(chosen) < 2:
            break
        less = [other for other in chosen if other != index]
        # Lower than the threshold for adding: a term stays unless it is clearly superfluous.
        if problem.block_gain(problem.unseen(less), problem.unseen(chosen)) < 2.0:
            chosen = less
    return chosen


def usual_sizes(shooting: Shooting) -> dict[str, float]:
    """Returns the root mean square of states and actions by name."""
    windows = shooting.windows
    names = (*windows.system.state_names, *windows.system.action_names)
    values = (*windows.states.T, *windows.actions.T)
    return {name: float(np.sqrt(np.mean(column**2))) for name, column in zip(names, values, strict=True)}


def _columns(trial: EffectTrial, shooting: Shooting, states: Sequence[str], terms: Sequence[HasValues]) -> FloatArray:
    """Returns the change of the reduced residual by a coefficient of 1, (windows, n, states * terms)."""
    system = shooting.windows.system
    seconds, values = _integrands(trial, shooting, terms)
    # T(t) T(s)^-1 propagates a rate at time s to the prediction at t; the tangent is known at compared rows.
    tangent = shooting.tangent
    inverse = _inverses(tangent)
    # Trapezoidal rule over each interval.
    first, second = (0.5 * seconds[..., None] * end for end in values)
    whole = np.zeros((*tangent.shape[:3], len(states) * len(terms)))
    for number, state in enumerate(states):
        adjoint = inverse[..., system.state_names.index(state), None]  # T(s)^-1 e
        steps = adjoint[:, :-1] * first[:, :, None]
        steps += adjoint[:, 1:] * second[:, :, None]
        sums = np.cumsum(steps, axis=1, out=steps)
        whole[:, 1:, :, number * len(terms) : (number + 1) * len(terms)] = tangent[:, 1:] @ sums
    return shooting.eliminated(whole, trial.fit.scale)


def _inverses(matrices: FloatArray) -> FloatArray:
    """Returns inverses (..., n, n); pseudo-inverses if a direction of the start no longer affects the prediction."""
    if (np.abs(np.linalg.det(matrices)) > _REGULAR).all():
        return np.asarray(np.linalg.inv(matrices))
    return np.asarray(np.linalg.pinv(matrices, rcond=1e-9))


def _integrands(
    trial: EffectTrial, shooting: Shooting, terms: Sequence[HasValues]
) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
    """Returns the length [s] of each interval between compared rows, and all terms at both ends.

    Shapes: (windows, intervals) and twice (windows, intervals, terms).
    """
    windows, system = shooting.windows, shooting.windows.system
    model = trial.fit.model
    predicted = shooting.residuals([model])[0] + shooting.measured
    # Rows without weight (glitches) are replaced by the prediction.
    states = np.where(shooting.counts > 0, shooting.measured, predicted)
    at = np.minimum(windows.start[:, None] + shooting.rows, windows.end[:, None])
    effective = effective_actions(model, windows)
    sums = np.concatenate([np.zeros((1, len(system.action))), np.cumsum(effective, axis=0)])
    past = [term for term in terms if isinstance(term, PastAction)]
    rows = np.maximum(at[:, 1:] - at[:, :-1], 1)
    # Actions change within an interval, so their mean over its rows is used; states are smooth.
    means = (sums[np.minimum(at[:, :-1] + rows, len(sums) - 1)] - sums[at[:, :-1]]) / rows[..., None]
    known = {}
    for item in (term for term in terms if isinstance(term, RowTerm)):
        total = np.concatenate([[0.0], np.cumsum(item.values)])
        known[item.name] = (total[np.minimum(at[:, :-1] + rows, len(sums) - 1)] - total[at[:, :-1]]) / rows
    ends = []
    for part, time in ((states[:, :-1], at[:, :-1]), (states[:, 1:], at[:, 1:])):
        named = {name: part[..., index] for index, name in enumerate(system.state_names)}
        named |= {name: means[..., index] for index, name in enumerate(system.action_names)}
        named |= known
        named[TIME] = windows.time[time]
        for term in past:
            # Before the first row of a stretch its first action held.
            before = np.maximum(time - term.rows, windows.begin[:, None])
            named[term.key] = effective[before, system.action_names.index(term.action)]
        values = [np.broadcast_to(term.value(named, NUMPY), time.shape) for term in terms]
        ends.append(np.stack(values, axis=-1))
    seconds = np.diff(windows.clock[at], axis=1)
    return seconds, (ends[0], ends[1])
