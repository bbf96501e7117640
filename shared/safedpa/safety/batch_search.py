"""``Conditions`` and ``search`` for many robots at once: the same steps, with those that are done left out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import AbstractDynamics, LearnedBase, PhysicsModel
from safedpa.safety.batch_barriers import ManyScenes
from safedpa.safety.batch_nearest import nearest_kept_by_many
from safedpa.safety.conditions import NO_INFLUENCE, ROUNDING
from safedpa.safety.search import DOUBTFUL, FAR, NEEDLESS, SERVED_WELL, overshot
from safedpa.safety.settings import FilterSettings
from safedpa.safety.tangent import MARK

__all__ = ["ManyConditions", "ManyOutcomes", "ManyPredictions", "search_by_many"]

Values = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

_TINY = 1e-300


@final
class ManyPredictions:
    """x[t+1] = f + g a at the states (robots, 4) of a moment: networks are asked once, physics for every action."""

    def __init__(self, model: AbstractDynamics, state: Values, latent: Values | None) -> None:
        self._model, self.state, self._latent = model, state, latent
        self._affine: tuple[Values, Values] | None = None
        if isinstance(model, PhysicsModel) and isinstance(model.base, LearnedBase) and not model.effects:
            known = np.zeros((len(state), 0)) if latent is None else latent
            f, g = model.base.networks.increment(state, known)
            self._affine = state + f, g

    def only(self, which: Indices) -> ManyPredictions:
        """Those of the robots of these indices."""
        some = object.__new__(ManyPredictions)
        some._model, some.state = self._model, self.state[which]
        some._latent = None if self._latent is None else self._latent[which]
        some._affine = None if self._affine is None else (self._affine[0][which], self._affine[1][which])
        return some

    def next_state(self, action: Values) -> Values:
        """(robots, 4) under ``action`` (robots, 2)."""
        if self._affine is not None:
            return np.asarray(self._affine[0] + (self._affine[1] @ action[:, :, np.newaxis])[..., 0])
        return np.asarray(self._model.step(self.state, action, self._latent))

    def slopes(self, around: Values) -> Values:
        """g (robots, 4, 2) about ``around`` (robots, 2)."""
        if self._affine is not None:
            return self._affine[1].copy()
        return np.array(self._model.affine(self.state, self._latent, around=around)[1])


@final
@dataclass(frozen=True, eq=False)
class ManyOutcomes:
    """What the model predicts for one action (robots, 2) each; see ``Outcome``."""

    action: Values
    next_state: Values
    h_next: Values
    residual: Values

    def only(self, which: Indices | Flags) -> ManyOutcomes:
        """Those of the robots of these indices; a copy."""
        return ManyOutcomes(self.action[which], self.next_state[which], self.h_next[which], self.residual[which])

    def put(self, which: Indices, other: ManyOutcomes) -> None:
        """Takes over the other's for the robots of these indices."""
        for own, new in zip(self._arrays(), other._arrays(), strict=True):
            own[which] = new

    def _arrays(self) -> tuple[Values, ...]:
        return self.action, self.next_state, self.h_next, self.residual


@final
@dataclass(frozen=True, eq=False)
class ManyConditions:
    """h_i(x[t+1]) >= required_i for every robot, with its barriers and its prediction."""

    settings: FilterSettings
    scenes: ManyScenes
    predictions: ManyPredictions
    required: Values
    """(robots, rows)."""
    scale: Values
    """(robots, rows), grows with every tangent."""

    def only(self, which: Indices) -> ManyConditions:
        """Those of the robots of these indices."""
        return ManyConditions(
            self.settings,
            self.scenes.only(which),
            self.predictions.only(which),
            self.required[which],
            self.scale[which],
        )

    def tightest(self, found: ManyOutcomes) -> Values:
        """(robots,) smallest residual, each as a share of its barrier's scale."""
        return np.asarray((found.residual / np.maximum(self.scale, _TINY)).min(axis=1))

    def distance(self, one: Values, other: Values) -> Values:
        """(robots,) between actions (robots, 2), as ``QuadraticProgram.distance``."""
        weights = self.settings.weight_vector
        share = (one - other) / (self.settings.high - self.settings.low)
        return np.asarray(share**2 @ (weights / weights.max()))

    def kept(self, found: ManyOutcomes) -> Flags:
        """(robots,) whether every condition holds, and every h is 0 or more."""
        return np.asarray(((found.residual >= -ROUNDING * self.scale) & (found.h_next >= 0.0)).all(axis=1))

    def outcome(self, action: Values) -> ManyOutcomes:
        """What ``action`` (robots, 2) leads to."""
        following = self.predictions.next_state(action)
        h_next = self.scenes.values(following)
        return ManyOutcomes(action, following, h_next, h_next - self.required)

    def slopes(self, about: ManyOutcomes, last: Values) -> Values:
        """A (robots, rows, 2) of the conditions tangent at ``about``; ``last`` (robots, 4, 2) are the slopes of the
        model that were used before, NaN where there are none, and become those that are used now."""
        g = self.predictions.slopes(about.action)
        reached, width = about.next_state, self.settings.high - self.settings.low
        noise = NO_INFLUENCE * np.maximum(np.abs(reached), np.abs(reached - self.predictions.state))
        silent = np.asarray((np.abs(g) * width <= noise[:, :, np.newaxis]).all(axis=1))
        for index in range(g.shape[2]):
            rows = np.flatnonzero(silent[:, index])
            if len(rows):
                known = np.isfinite(last[rows, 0, index])
                g[rows[known], :, index] = last[rows[known], :, index]
                fresh = rows[~known]
                g[fresh, :, index] = self.only(fresh)._chords(about.only(fresh), index)
        last[:] = g
        slopes = np.asarray(self.scenes.gradient(about.next_state) @ g)
        np.maximum(self.scale, np.abs(slopes) @ width, out=self.scale)
        return slopes

    def _chords(self, about: ManyOutcomes, index: int) -> Values:
        """(robots, 4) in place of a slope that vanishes: to the bound of the action that is further away."""
        low, high = self.settings.low[index], self.settings.high[index]
        value, other = about.action[:, index], about.action.copy()
        other[:, index] = np.where(value - low > high - value, low, high)
        return (self.predictions.next_state(other) - about.next_state) / (other[:, index] - value)[:, np.newaxis]


def search_by_many(conditions: ManyConditions, wish: Values, start: ManyOutcomes) -> tuple[ManyOutcomes, Flags]:
    """The outcomes that ``search`` finds by posing the program, and where they are certain.

    Not certain are those whose program needed slack on the way, and those that ``search`` would not take as they are:
    the filter of one robot has to answer these.
    """
    settings, robots = conditions.settings, len(wish)
    last = np.full((robots, 4, 2), np.nan)
    A = conditions.slopes(start, last)
    about, before = start.only(np.arange(robots)), start.only(np.arange(robots))
    certain, plain = np.ones(robots, dtype=bool), np.zeros(robots, dtype=bool)
    missing, overshoot = np.maximum(0.0, -conditions.tightest(start)), np.zeros(robots)
    for index in range(settings.relinearisations + 1):
        going = np.flatnonzero(certain & ~plain)
        if len(going) == 0:
            break
        own = conditions.only(going)
        before.put(going, about.only(going))
        found, certain[going] = _posed(own, A[going], about.only(going), wish[going], overshoot[going])
        about.put(going, found)
        tightest = own.tightest(found)
        kept = own.kept(found)
        plain[going] = kept & _as_it_is(own, wish[going], found, tightest, before.only(going), index)
        certain[going] &= plain[going] | ~kept  # a kept one that is not taken is for the filter of one robot
        last_missing, now = missing[going], np.maximum(0.0, -tightest)
        fresh = ~((now > 0.0) & (now < SERVED_WELL * last_missing))
        missing[going] = now
        pairs = zip(last_missing.tolist(), now.tolist(), strict=True)
        overshoot[going] = [overshot(index + 1, *pair) for pair in pairs]
        anew = going[fresh & certain[going] & ~plain[going]]
        if len(anew) and index < settings.relinearisations:
            _draw(conditions, A, anew, about, last)
    return about, certain & plain


def _as_it_is(
    conditions: ManyConditions, wish: Values, found: ManyOutcomes, tightest: Values, before: ManyOutcomes, index: int
) -> Flags:
    """(robots,) where ``search`` takes a solution that keeps all conditions without looking any further."""
    far = FAR * FAR
    doubtful = (tightest > DOUBTFUL) & (conditions.distance(found.action, wish) > far)
    moved = (conditions.distance(found.action, before.action) > far) & (index > 0)
    return np.asarray((tightest <= NEEDLESS) & ~doubtful & ~moved)


def _draw(conditions: ManyConditions, A: Values, which: Indices, about: ManyOutcomes, last: Values) -> None:
    """New slopes for the robots of these indices."""
    some, known = conditions.only(which), last[which]
    A[which] = some.slopes(about.only(which), known)
    last[which], conditions.scale[which] = known, some.scale


def _posed(
    conditions: ManyConditions, A: Values, about: ManyOutcomes, wish: Values, overshoot: Values
) -> tuple[ManyOutcomes, Flags]:
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
    robots = len(wish)
    slopes = np.concatenate([A * width / safe[..., np.newaxis], np.broadcast_to(box, (robots, 4, 2))], axis=1)
    own = np.where(moved, limits / safe, -np.inf)  # a row that no action changes is none of the program's
    limits = np.concatenate([own, np.broadcast_to([0.0, -1.0, 0.0, -1.0], (robots, 4))], axis=1)
    scaled = (wish - low) / width
    point, certain = nearest_kept_by_many(slopes, limits, scaled, settings.weight_vector)
    action = np.clip(low + width * np.where(certain[:, np.newaxis], point, 0.0), low, settings.high)
    return conditions.outcome(action), certain
