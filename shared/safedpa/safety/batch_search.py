"""``Conditions`` and ``search`` for many robots at once: the same steps, with those that are done left out."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import AbstractDynamics, LearnedBase, PhysicsModel
from safedpa.safety.batch_barriers import ManyScenes
from safedpa.safety.batch_nearest import nearest_kept_by_many
from safedpa.safety.conditions import NO_INFLUENCE
from safedpa.safety.search import NEEDLESS, SAME, SERVED_WELL, TIE
from safedpa.safety.settings import FilterSettings

__all__ = ["ManyConditions", "ManyOutcomes", "ManyPredictions", "search_by_many"]

Values = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]


@final
class ManyPredictions:
    """x[t+1] = f + g a at the states (robots, 4) of a moment: networks are asked once, physics for every action."""

    def __init__(self, model: AbstractDynamics, state: Values, latent: Values | None) -> None:
        self._model, self._state, self._latent = model, state, latent
        self._affine: tuple[Values, Values] | None = None
        if isinstance(model, PhysicsModel) and isinstance(model.base, LearnedBase) and not model.effects:
            known = np.zeros((len(state), 0)) if latent is None else latent
            f, g = model.base.networks.increment(state, known)
            self._affine = state + f, g

    def only(self, which: Indices) -> ManyPredictions:
        """Those of the robots of these indices."""
        some = object.__new__(ManyPredictions)
        some._model, some._state = self._model, self._state[which]
        some._latent = None if self._latent is None else self._latent[which]
        some._affine = None if self._affine is None else (self._affine[0][which], self._affine[1][which])
        return some

    def next_state(self, action: Values) -> Values:
        """(robots, 4) under ``action`` (robots, 2)."""
        if self._affine is not None:
            return np.asarray(self._affine[0] + (self._affine[1] @ action[:, :, np.newaxis])[..., 0])
        return np.asarray(self._model.step(self._state, action, self._latent))

    def slopes(self, around: Values) -> Values:
        """g (robots, 4, 2) about ``around`` (robots, 2)."""
        if self._affine is not None:
            return self._affine[1].copy()
        return np.array(self._model.affine(self._state, self._latent, around=around)[1])


@final
@dataclass(frozen=True, eq=False)
class ManyOutcomes:
    """What the model predicts for one action (robots, 2) each; see ``Outcome``."""

    action: Values
    next_state: Values
    h_next: Values
    residual: Values

    @property
    def tightest(self) -> Values:
        """(robots,) smallest residual."""
        return np.asarray(self.residual.min(axis=1))

    @property
    def violation(self) -> Values:
        """(robots,) the slack that the action needs."""
        return np.maximum(0.0, -self.tightest)

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

    def only(self, which: Indices) -> ManyConditions:
        """Those of the robots of these indices."""
        return ManyConditions(
            self.settings, self.scenes.only(which), self.predictions.only(which), self.required[which]
        )

    def outcome(self, action: Values) -> ManyOutcomes:
        """What ``action`` (robots, 2) leads to."""
        following = self.predictions.next_state(action)
        h_next = self.scenes.values(following)
        return ManyOutcomes(action, following, h_next, h_next - self.required)

    def slopes(self, about: ManyOutcomes, last: Values) -> Values:
        """A (robots, rows, 2) of the conditions tangent at ``about``; ``last`` (robots, 4, 2) are the slopes of the
        model that were used before, NaN where there are none, and become those that are used now."""
        g = self.predictions.slopes(about.action)
        noise = NO_INFLUENCE * (1.0 + np.abs(about.next_state).max(axis=1))
        silent = np.abs(g).max(axis=1) <= noise[:, np.newaxis]
        for index in range(g.shape[2]):
            rows = np.flatnonzero(silent[:, index])
            if len(rows):
                known = np.isfinite(last[rows, 0, index])
                g[rows[known], :, index] = last[rows[known], :, index]
                fresh = rows[~known]
                g[fresh, :, index] = self.only(fresh)._chords(about.only(fresh), index)
        last[:] = g
        return np.asarray(self.scenes.gradient(about.next_state) @ g)

    def _chords(self, about: ManyOutcomes, index: int) -> Values:
        """(robots, 4) in place of a slope that vanishes: to the bound of the action that is further away."""
        low, high = self.settings.low[index], self.settings.high[index]
        value, other = about.action[:, index], about.action.copy()
        other[:, index] = np.where(value - low > high - value, low, high)
        return (self.predictions.next_state(other) - about.next_state) / (other[:, index] - value)[:, np.newaxis]


def search_by_many(conditions: ManyConditions, wish: Values, start: ManyOutcomes) -> tuple[ManyOutcomes, Flags]:
    """The best outcomes found, as ``search`` finds them, and where they are certain.

    Not certain are those whose program needed slack on the way: the filter of one robot has to answer these.
    """
    settings = conditions.settings
    tolerance, width = settings.slack_tolerance, settings.high - settings.low
    last = np.full((len(wish), 4, len(width)), np.nan)
    A = conditions.slopes(start, last)
    about, certain = _posed(conditions, A, start, wish)
    best, before = about.only(np.arange(len(wish))), start.only(np.arange(len(wish)))
    fresh, done = np.ones(len(wish), dtype=bool), np.zeros(len(wish), dtype=bool)
    for _ in range(settings.relinearisations):
        done |= (about.violation <= tolerance) & (about.tightest <= NEEDLESS * tolerance)
        done |= fresh & (np.abs(about.action - before.action) <= SAME * width).all(axis=1)
        going = np.flatnonzero(certain & ~done)
        if len(going) == 0:
            break
        here, there = about.only(going), before.only(going)
        fresh[going] = ~((tolerance < here.violation) & (here.violation < SERVED_WELL * there.violation))
        anew = going[fresh[going]]
        if len(anew):
            known = last[anew]
            A[anew] = conditions.only(anew).slopes(about.only(anew), known)
            last[anew] = known
        before.put(going, here)
        found, good = _posed(conditions.only(going), A[going], here, wish[going])
        about.put(going, found)
        certain[going] = good
        better = _better(settings, wish[going], best.only(going), found)
        best.put(going[better], found.only(better))
    return best, certain


def _posed(conditions: ManyConditions, A: Values, about: ManyOutcomes, wish: Values) -> tuple[ManyOutcomes, Flags]:
    """The outcomes of the programs' solutions without slack, and where these are certain."""
    settings = conditions.settings
    low, width = settings.low, settings.high - settings.low
    limits = (A @ about.action[:, :, np.newaxis])[..., 0] - about.residual - A @ low
    box = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    robots = len(wish)
    slopes = np.concatenate([A * width, np.broadcast_to(box, (robots, 4, 2))], axis=1)
    limits = np.concatenate([limits, np.broadcast_to([0.0, -1.0, 0.0, -1.0], (robots, 4))], axis=1)
    prices = np.concatenate([np.full(A.shape[1], settings.slack_linear), np.full(4, inf)])
    scaled = (wish - low) / width
    point, certain = nearest_kept_by_many(slopes, limits, prices, scaled, settings.weight_vector)
    action = np.clip(low + width * np.where(certain[:, np.newaxis], point, 0.0), low, settings.high)
    return conditions.outcome(action), certain


def _better(settings: FilterSettings, wish: Values, one: ManyOutcomes, other: ManyOutcomes) -> Any:
    """Where the other is the better one."""
    width, weights = settings.high - settings.low, settings.weight_vector
    cost, costs = ((((found.action - wish) / width) ** 2) @ weights for found in (one, other))
    both = np.maximum(one.violation, other.violation) <= settings.slack_tolerance
    return np.where(both, costs < cost, other.violation < one.violation - TIE)
