"""``Constraints`` and ``solve_sqp`` for many robots at once: the same steps, without the robots that are done."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from safedpa.arrays import BoolArray, FloatArray, IndexArray
from safedpa.safety.batch.active_set_2d import solve_hard_qp_2d_batch
from safedpa.safety.batch.barriers import AbstractBatchBarriers
from safedpa.safety.batch.predictor import AbstractBatchPredictor
from safedpa.safety.settings import FilterSettings
from safedpa.safety.solver.constraints import NO_INFLUENCE, ROUNDING
from safedpa.safety.solver.linearization import MARK
from safedpa.safety.solver.sqp import DOUBTFUL, FAR, NEEDLESS, SERVED_WELL, STEP, tighten

__all__ = ["BatchCandidates", "BatchConstraints", "solve_sqp_batch"]


_TINY = 1e-300
"""As in ``solver.constraints``: it only avoids a division by zero."""


@final
@dataclass(frozen=True, eq=False)
class BatchCandidates:
    """One action (robots, actions) each with its prediction; see ``ActionCandidate``."""

    action: FloatArray
    next_state: FloatArray
    h_next: FloatArray
    residual: FloatArray

    def only(self, which: IndexArray | BoolArray) -> BatchCandidates:
        """The candidates of the robots of these indices; a copy."""
        return BatchCandidates(self.action[which], self.next_state[which], self.h_next[which], self.residual[which])

    def put(self, which: IndexArray, other: BatchCandidates) -> None:
        """Overwrites the candidates of the robots of these indices."""
        for own, new in zip(self._arrays(), other._arrays(), strict=True):
            own[which] = new

    def _arrays(self) -> tuple[FloatArray, ...]:
        return self.action, self.next_state, self.h_next, self.residual


@final
@dataclass(frozen=True, eq=False)
class BatchConstraints:
    """h_i(x[t+1]) >= rhs_i for every robot, with its barriers and its prediction."""

    settings: FilterSettings
    barriers: AbstractBatchBarriers
    predictions: AbstractBatchPredictor
    rhs: FloatArray
    """(robots, rows) right-hand sides."""
    scale: FloatArray
    """(robots, rows), grows with every linearisation."""
    saturated: BoolArray
    """(robots,) whether some column of g was a chord, since the actuator saturates there."""

    def only(self, which: IndexArray) -> BatchConstraints:
        """The constraints of the robots of these indices."""
        return BatchConstraints(
            self.settings,
            self.barriers.only(which),
            self.predictions.only(which),
            self.rhs[which],
            self.scale[which],
            self.saturated[which],
        )

    def min_scaled_residual(self, found: BatchCandidates) -> FloatArray:
        """(robots,) smallest residual, each as a share of its barrier's scale."""
        return np.asarray((found.residual / np.maximum(self.scale, _TINY)).min(axis=1))

    def distance(self, one: FloatArray, other: FloatArray) -> FloatArray:
        """(robots,) the distance of actions (robots, actions), as ``QuadraticProgram.distance``."""
        weights = self.settings.weight_vector
        share = (one - other) / (self.settings.high - self.settings.low)
        return np.asarray(share**2 @ (weights / weights.max()))

    def is_feasible(self, found: BatchCandidates) -> BoolArray:
        """(robots,) whether every constraint holds, and every predicted h is finite and >= 0."""
        # The same tolerance as for one robot, or both would disagree at the boundary.
        rows = (found.residual >= -ROUNDING * self.scale) & (found.h_next >= 0.0) & np.isfinite(found.h_next)
        return np.asarray(rows.all(axis=1) & np.isfinite(found.next_state).all(axis=1))

    def evaluate(self, action: FloatArray) -> BatchCandidates:
        """Predicts the next state and h under ``action`` (robots, actions)."""
        following = self.predictions.next_state(action)
        h_next = self.barriers.h(following)
        return BatchCandidates(action, following, h_next, h_next - self.rhs)

    def linearize(self, about: BatchCandidates, last: FloatArray) -> FloatArray:
        """Returns A (robots, rows, actions) of the constraints linearised about ``about``.

        ``last`` (robots, states, actions) is the g of the linearisation before, NaN if there is none; it is replaced by
        the one of now.
        """
        g = self.predictions.control_matrix(about.action)
        next_state, width = about.next_state, self.settings.high - self.settings.low
        noise = NO_INFLUENCE * np.maximum(np.abs(next_state), np.abs(next_state - self.predictions.state))
        no_influence = np.asarray((np.abs(g) * width <= noise[:, :, np.newaxis]).all(axis=1))
        # An affine model cannot saturate: a vanished column there is a true zero.
        if not self.predictions.affine:
            np.logical_or(self.saturated, no_influence.any(axis=1), out=self.saturated)
        for index in range(g.shape[2]):
            rows = np.flatnonzero(no_influence[:, index])
            if len(rows):
                # As for one robot: an earlier derivative replaces a vanished column, and only without one a chord is
                # evaluated.
                known = np.isfinite(last[rows, 0, index])
                g[rows[known], :, index] = last[rows[known], :, index]
                unknown = rows[~known]
                g[unknown, :, index] = self.only(unknown)._chords(about.only(unknown), index)
        last[:] = g
        A = self.barriers.lie_derivative(about.next_state, g, width)
        # In place, since the scale is shared with the caller's constraints.
        np.maximum(self.scale, np.abs(A) @ width, out=self.scale)
        return A

    def _chords(self, about: BatchCandidates, index: int) -> FloatArray:
        """(robots, states) chords in place of columns that vanish: to the bound that is further away."""
        low, high = self.settings.low[index], self.settings.high[index]
        value, other = about.action[:, index], about.action.copy()
        other[:, index] = np.where(value - low > high - value, low, high)
        return (self.predictions.next_state(other) - about.next_state) / (other[:, index] - value)[:, np.newaxis]


def solve_sqp_batch(
    constraints: BatchConstraints, nominal: FloatArray, start: BatchCandidates
) -> tuple[BatchCandidates, BoolArray]:
    """Returns the candidates that ``solve_sqp`` would find, and where this is certain.

    Not certain are robots whose program needed slack, and those for which ``solve_sqp`` would search further: the
    filter of one robot decides these.
    """
    settings, robots = constraints.settings, len(nominal)
    last = np.full((*start.next_state.shape, nominal.shape[1]), np.nan)
    # The first violation is measured before the linearisation enlarges the scale, as for one robot.
    violation, overshoot = np.maximum(0.0, -constraints.min_scaled_residual(start)), np.zeros(robots)
    A = constraints.linearize(start, last)
    # Two copies: both are overwritten robot by robot.
    about, before = start.only(np.arange(robots)), start.only(np.arange(robots))
    certain, accepted = np.ones(robots, dtype=bool), np.zeros(robots, dtype=bool)
    for index in range(settings.relinearisations + 1):
        active = np.flatnonzero(certain & ~accepted)
        if len(active) == 0:
            break
        subset = constraints.only(active)
        # Copied before the solution below overwrites it: after a long last step the filter of one robot decides.
        before.put(active, about.only(active))
        found, certain[active] = _solve_programs(
            subset, A[active], about.only(active), nominal[active], overshoot[active]
        )
        about.put(active, found)
        min_residual = subset.min_scaled_residual(found)
        feasible = subset.is_feasible(found)
        accepted[active] = feasible & _is_final(
            subset, nominal[active], found, min_residual, before.only(active), index
        )
        # A feasible candidate that is not final would be moved further: that is left to the filter of one robot.
        certain[active] &= accepted[active] | ~feasible
        last_violation, now = violation[active], np.maximum(0.0, -min_residual)
        relinearize = ~((now > 0.0) & (now < SERVED_WELL * last_violation))
        violation[active] = now
        pairs = zip(last_violation.tolist(), now.tolist(), strict=True)
        overshoot[active] = [tighten(index + 1, *pair) for pair in pairs]
        again = active[relinearize & certain[active] & ~accepted[active]]
        if len(again) and index < settings.relinearisations:
            _relinearize(constraints, A, again, about, last)
    return about, certain & accepted


def _is_final(
    constraints: BatchConstraints,
    nominal: FloatArray,
    found: BatchCandidates,
    min_residual: FloatArray,
    before: BatchCandidates,
    index: int,
) -> BoolArray:
    """(robots,) whether ``solve_sqp`` would return this feasible solution without searching further."""
    far = FAR * FAR
    # In these cases the filter of one robot would search further, so the batch leaves the robot to it.
    doubtful = ((min_residual > DOUBTFUL) | constraints.saturated) & (constraints.distance(found.action, nominal) > far)
    moved = (constraints.distance(found.action, before.action) > far) & (index > 0)
    return np.asarray((min_residual <= NEEDLESS) & ~doubtful & ~moved & ~_would_backtrack(constraints, nominal, found))


def _would_backtrack(constraints: BatchConstraints, nominal: FloatArray, found: BatchCandidates) -> BoolArray:
    """(robots,) whether ``backtrack_towards`` would move an entry of the solution."""
    low, high = constraints.settings.low, constraints.settings.high
    # Towards the clipped nominal action: beyond the bounds there is nothing to gain.
    away = np.clip(nominal, low, high) - found.action
    step = STEP * (high - low)
    back = np.zeros(len(nominal), dtype=bool)
    for entry in range(nominal.shape[1]):
        far = np.flatnonzero(np.abs(away[:, entry]) > step[entry])
        if len(far) == 0:
            continue
        nearer = found.action[far]
        nearer[:, entry] += np.copysign(step[entry], away[far, entry])
        own = constraints.only(far)
        back[far] |= own.is_feasible(own.evaluate(nearer))
    return back


def _relinearize(
    constraints: BatchConstraints, A: FloatArray, which: IndexArray, about: BatchCandidates, last: FloatArray
) -> None:
    """Linearises again for the robots of these indices."""
    some, known = constraints.only(which), last[which]
    A[which] = some.linearize(about.only(which), known)
    last[which], constraints.scale[which], constraints.saturated[which] = known, some.scale, some.saturated


def _solve_programs(
    constraints: BatchConstraints, A: FloatArray, about: BatchCandidates, nominal: FloatArray, overshoot: FloatArray
) -> tuple[BatchCandidates, BoolArray]:
    """The candidates of the programs' solutions without slack, and where these are proven."""
    settings = constraints.settings
    low, width = settings.low, settings.high - settings.low
    reach = np.abs(A) @ width
    violation = np.minimum(about.residual, 0.0)
    limits = (
        (A @ about.action[:, :, np.newaxis])[..., 0]
        - about.residual
        - overshoot[:, np.newaxis] * violation
        + MARK * reach
        - A @ low
    )
    has_influence = reach > 0.0
    # Rows are divided by their reach as in ``violable_rows``; a row without influence gets no limit.
    safe = np.where(has_influence, reach, 1.0)
    box = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    rows = _in_the_plane(A * width / safe[..., np.newaxis])
    robots = len(nominal)
    gradients = np.concatenate([rows, np.broadcast_to(box, (robots, 4, 2))], axis=1)
    # A row without influence cannot be satisfied by any action: it must not make the program infeasible.
    own = np.where(has_influence, limits / safe, -np.inf)
    limits = np.concatenate([own, np.broadcast_to([0.0, -1.0, 0.0, -1.0], (robots, 4))], axis=1)
    scaled, weights = _in_the_plane((nominal - low) / width), np.resize(settings.weight_vector, 2)
    point, certain = solve_hard_qp_2d_batch(gradients, limits, scaled, weights)
    own = point[:, : len(low)]
    action = np.clip(low + width * np.where(certain[:, np.newaxis], own, 0.0), low, settings.high)
    return constraints.evaluate(action), certain


def _in_the_plane(numbers: FloatArray) -> FloatArray:
    """(..., 2) of numbers of two actions; a single action is paired with one that has no effect."""
    missing = 2 - numbers.shape[-1]
    return numbers if not missing else np.concatenate([numbers, np.zeros_like(numbers)], axis=-1)
