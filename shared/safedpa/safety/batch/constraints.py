"""``Conditions`` and ``search`` for many robots at once: the same steps, with those that are done left out."""

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

__all__ = ["BatchCandidates", "BatchConstraints", "search_batch"]


_TINY = 1e-300


@final
@dataclass(frozen=True, eq=False)
class BatchCandidates:
    """What the model predicts for one action (robots, actions) each; see ``Outcome``."""

    action: FloatArray
    next_state: FloatArray
    h_next: FloatArray
    residual: FloatArray

    def only(self, which: IndexArray | BoolArray) -> BatchCandidates:
        """Those of the robots of these indices; a copy."""
        return BatchCandidates(self.action[which], self.next_state[which], self.h_next[which], self.residual[which])

    def put(self, which: IndexArray, other: BatchCandidates) -> None:
        """Takes over the other's for the robots of these indices."""
        for own, new in zip(self._arrays(), other._arrays(), strict=True):
            own[which] = new

    def _arrays(self) -> tuple[FloatArray, ...]:
        return self.action, self.next_state, self.h_next, self.residual


@final
@dataclass(frozen=True, eq=False)
class BatchConstraints:
    """h_i(x[t+1]) >= required_i for every robot, with its barriers and its prediction."""

    settings: FilterSettings
    barriers: AbstractBatchBarriers
    predictions: AbstractBatchPredictor
    required: FloatArray
    """(robots, rows)."""
    scale: FloatArray
    """(robots, rows), grows with every tangent."""
    saturated: BoolArray
    """(robots,) whether some slope was that of a chord, since the actuator saturates there."""

    def only(self, which: IndexArray) -> BatchConstraints:
        """Those of the robots of these indices."""
        return BatchConstraints(
            self.settings,
            self.barriers.only(which),
            self.predictions.only(which),
            self.required[which],
            self.scale[which],
            self.saturated[which],
        )

    def tightest(self, found: BatchCandidates) -> FloatArray:
        """(robots,) smallest residual, each as a share of its barrier's scale."""
        return np.asarray((found.residual / np.maximum(self.scale, _TINY)).min(axis=1))

    def distance(self, one: FloatArray, other: FloatArray) -> FloatArray:
        """(robots,) between actions (robots, actions), as ``QuadraticProgram.distance``."""
        weights = self.settings.weight_vector
        share = (one - other) / (self.settings.high - self.settings.low)
        return np.asarray(share**2 @ (weights / weights.max()))

    def kept(self, found: BatchCandidates) -> BoolArray:
        """(robots,) whether every condition holds, and every h is 0 or more, of what was predicted in finite numbers."""
        rows = (found.residual >= -ROUNDING * self.scale) & (found.h_next >= 0.0) & np.isfinite(found.h_next)
        return np.asarray(rows.all(axis=1) & np.isfinite(found.next_state).all(axis=1))

    def outcome(self, action: FloatArray) -> BatchCandidates:
        """What ``action`` (robots, actions) leads to."""
        following = self.predictions.next_state(action)
        h_next = self.barriers.values(following)
        return BatchCandidates(action, following, h_next, h_next - self.required)

    def slopes(self, about: BatchCandidates, last: FloatArray) -> FloatArray:
        """A (robots, rows, actions) of the conditions tangent at ``about``.

        ``last`` (robots, states, actions) are the slopes of the model that were used before, NaN where there are none,
        and become those that are used now.
        """
        g = self.predictions.slopes(about.action)
        reached, width = about.next_state, self.settings.high - self.settings.low
        noise = NO_INFLUENCE * np.maximum(np.abs(reached), np.abs(reached - self.predictions.state))
        silent = np.asarray((np.abs(g) * width <= noise[:, :, np.newaxis]).all(axis=1))
        if not self.predictions.affine:
            np.logical_or(self.saturated, silent.any(axis=1), out=self.saturated)
        for index in range(g.shape[2]):
            rows = np.flatnonzero(silent[:, index])
            if len(rows):
                known = np.isfinite(last[rows, 0, index])
                g[rows[known], :, index] = last[rows[known], :, index]
                fresh = rows[~known]
                g[fresh, :, index] = self.only(fresh)._chords(about.only(fresh), index)
        last[:] = g
        slopes = self.barriers.along(about.next_state, g, width)
        np.maximum(self.scale, np.abs(slopes) @ width, out=self.scale)
        return slopes

    def _chords(self, about: BatchCandidates, index: int) -> FloatArray:
        """(robots, states) in place of a slope that vanishes: to the bound of the action that is further away."""
        low, high = self.settings.low[index], self.settings.high[index]
        value, other = about.action[:, index], about.action.copy()
        other[:, index] = np.where(value - low > high - value, low, high)
        return (self.predictions.next_state(other) - about.next_state) / (other[:, index] - value)[:, np.newaxis]


def search_batch(
    conditions: BatchConstraints, nominal: FloatArray, start: BatchCandidates
) -> tuple[BatchCandidates, BoolArray]:
    """The outcomes that ``search`` finds by posing the program, and where they are certain.

    Not certain are those whose program needed slack on the way, and those that ``search`` would not take as they are:
    the filter of one robot has to answer these.
    """
    settings, robots = conditions.settings, len(nominal)
    last = np.full((*start.next_state.shape, nominal.shape[1]), np.nan)
    missing, overshoot = np.maximum(0.0, -conditions.tightest(start)), np.zeros(robots)  # before slopes widen the scale
    A = conditions.slopes(start, last)
    about, before = start.only(np.arange(robots)), start.only(np.arange(robots))
    certain, plain = np.ones(robots, dtype=bool), np.zeros(robots, dtype=bool)
    for index in range(settings.relinearisations + 1):
        going = np.flatnonzero(certain & ~plain)
        if len(going) == 0:
            break
        own = conditions.only(going)
        before.put(going, about.only(going))
        found, certain[going] = _build_constraints(own, A[going], about.only(going), nominal[going], overshoot[going])
        about.put(going, found)
        tightest = own.tightest(found)
        kept = own.kept(found)
        plain[going] = kept & _nominal_candidate(own, nominal[going], found, tightest, before.only(going), index)
        certain[going] &= plain[going] | ~kept  # a kept one that is not taken is for the filter of one robot
        last_missing, now = missing[going], np.maximum(0.0, -tightest)
        fresh = ~((now > 0.0) & (now < SERVED_WELL * last_missing))
        missing[going] = now
        pairs = zip(last_missing.tolist(), now.tolist(), strict=True)
        overshoot[going] = [tighten(index + 1, *pair) for pair in pairs]
        again = going[fresh & certain[going] & ~plain[going]]
        if len(again) and index < settings.relinearisations:
            _draw(conditions, A, again, about, last)
    return about, certain & plain


def _nominal_candidate(
    conditions: BatchConstraints,
    nominal: FloatArray,
    found: BatchCandidates,
    tightest: FloatArray,
    before: BatchCandidates,
    index: int,
) -> BoolArray:
    """(robots,) where ``search`` takes a solution that satisfies all conditions without looking any further."""
    far = FAR * FAR
    doubtful = ((tightest > DOUBTFUL) | conditions.saturated) & (conditions.distance(found.action, nominal) > far)
    moved = (conditions.distance(found.action, before.action) > far) & (index > 0)
    return np.asarray((tightest <= NEEDLESS) & ~doubtful & ~moved & ~_backtracking(conditions, nominal, found))


def _backtracking(conditions: BatchConstraints, nominal: FloatArray, found: BatchCandidates) -> BoolArray:
    """(robots,) where an entry of the solution is brought back towards the nominal action; see ``retreated``."""
    low, high = conditions.settings.low, conditions.settings.high
    away = np.clip(nominal, low, high) - found.action
    step = STEP * (high - low)
    back = np.zeros(len(nominal), dtype=bool)
    for entry in range(nominal.shape[1]):
        far = np.flatnonzero(np.abs(away[:, entry]) > step[entry])
        if len(far) == 0:
            continue
        nearer = found.action[far]
        nearer[:, entry] += np.copysign(step[entry], away[far, entry])
        own = conditions.only(far)
        back[far] |= own.kept(own.outcome(nearer))
    return back


def _draw(
    conditions: BatchConstraints, A: FloatArray, which: IndexArray, about: BatchCandidates, last: FloatArray
) -> None:
    """New slopes for the robots of these indices."""
    some, known = conditions.only(which), last[which]
    A[which] = some.slopes(about.only(which), known)
    last[which], conditions.scale[which], conditions.saturated[which] = known, some.scale, some.saturated


def _build_constraints(
    conditions: BatchConstraints, A: FloatArray, about: BatchCandidates, nominal: FloatArray, overshoot: FloatArray
) -> tuple[BatchCandidates, BoolArray]:
    """The outcomes of the programs' solutions without slack, and where these are certain."""
    settings = conditions.settings
    low, width = settings.low, settings.high - settings.low
    reach = np.abs(A) @ width
    missing = np.minimum(about.residual, 0.0)
    limits = (
        (A @ about.action[:, :, np.newaxis])[..., 0]
        - about.residual
        - overshoot[:, np.newaxis] * missing
        + MARK * reach
        - A @ low
    )
    moved = reach > 0.0
    safe = np.where(moved, reach, 1.0)
    box = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    rows = _in_the_plane(A * width / safe[..., np.newaxis])
    robots = len(nominal)
    slopes = np.concatenate([rows, np.broadcast_to(box, (robots, 4, 2))], axis=1)
    own = np.where(moved, limits / safe, -np.inf)  # a row that no action changes is none of the program's
    limits = np.concatenate([own, np.broadcast_to([0.0, -1.0, 0.0, -1.0], (robots, 4))], axis=1)
    scaled, weights = _in_the_plane((nominal - low) / width), np.resize(settings.weight_vector, 2)
    point, certain = solve_hard_qp_2d_batch(slopes, limits, scaled, weights)
    own = point[:, : len(low)]
    action = np.clip(low + width * np.where(certain[:, np.newaxis], own, 0.0), low, settings.high)
    return conditions.outcome(action), certain


def _in_the_plane(numbers: FloatArray) -> FloatArray:
    """(..., 2) of numbers of two actions, or of one next to a second one that nothing depends on."""
    missing = 2 - numbers.shape[-1]
    return numbers if not missing else np.concatenate([numbers, np.zeros_like(numbers)], axis=-1)
