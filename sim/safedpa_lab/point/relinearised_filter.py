"""The point robots' filter on a model that is not affine in the action: taken as affine about one action, or again.

About the nominal action what passes is judged without an error of the linearisation; what is corrected is not. About
the filter's own action: decide, take the model again about what was decided, decide again; then the error goes where
the action settles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray, IndexArray
from safedpa.errors import InputError, did_you_mean
from safedpa_lab.point.action_models import ActionModel
from safedpa_sim.point.filtering import ETA, FilteredActions, PointFilter, around_hazards, minimum_barrier
from safedpa_sim.point.point_model import PointPrediction

__all__ = ["ABOUT", "Decided", "RelinearisedFilter"]


ABOUT: Final = ("middle", "nominal", "own")
"""What the model is linearised about: no action, the nominal action, what was decided."""
_AGAIN: Final = 2
"""Decisions after the first, of those whose nominal action does not pass."""
_TOLERANCE: Final = 1e-6
"""m; of what is kept by the model itself."""
_SETTLED: Final = 1e-3
"""Of an action: one that moves less from where the model was taken as affine is not decided again."""


@final
@dataclass(frozen=True)
class Decided:
    """Actions (robots, 2) in [-1, 1], and the least room (robots,) [m] that is predicted with them."""

    action: FloatArray
    corrected: NDArray[np.bool_]
    relaxed: NDArray[np.bool_]
    predicted: FloatArray
    room: FloatArray
    """(robots,) [m]: the least one as they are."""


@final
class RelinearisedFilter:
    """``epsilon`` [m] is the margin; ``about`` one of ``ABOUT``, else InputError.

    Of the filter's own action the model itself says what it predicts; else what was affine says it.
    """

    def __init__(self, epsilon: float, about: str) -> None:
        if about not in ABOUT:
            raise InputError(f"linearised about '{about}': {did_you_mean(about, ABOUT)}")
        self._filter, self._epsilon, self._about = PointFilter(epsilon), epsilon, about

    def decide(self, state: FloatArray, nominal: FloatArray, hazards: FloatArray, model: ActionModel) -> Decided:
        """Safe actions for states (robots, 5), which the model sees, and nominal actions (robots, 2) among hazards."""
        model.see(state)
        everybody = np.arange(len(state))
        believed = model.about(np.zeros_like(nominal) if self._about == "middle" else nominal, everybody)
        if self._about == "own":
            found = self._settled(state, nominal, hazards, model, believed)
            following = model.following(found.action, everybody)
        else:
            found = self._filter.decide(state, nominal, hazards, believed)
            following = believed.next_state(found.action)
        around = around_hazards(hazards, believed.motion)
        predicted, room = (around.h(one).min(axis=1) for one in (following, state))
        return Decided(found.action, found.corrected, found.relaxed, predicted, room)

    def _settled(
        self, state: FloatArray, nominal: FloatArray, hazards: FloatArray, model: ActionModel, believed: PointPrediction
    ) -> FilteredActions:
        """A nominal action that passes by the model itself passes; others are decided about no action, then about what
        was decided.

        About no action first: about a saturated nominal action the thrust has no slope, so that no correction is found.
        What could not be solved, or falls short by the model itself, replaces only what is worse.
        """
        action, relaxed = nominal.copy(), np.zeros(len(nominal), bool)
        everybody = np.arange(len(nominal))
        short = self._retained(nominal, everybody, state, hazards, model, believed) < -_TOLERANCE
        outside = minimum_barrier(state, hazards, believed.motion) < 0.0
        which = np.flatnonzero(short | outside)
        retained, about = np.full(len(which), -np.inf), np.zeros((len(which), 2))
        relaxed[which] = True
        for _ in range(1 + _AGAIN):
            if not len(which):
                break
            near = model.about(about, which)
            new = self._filter.decide(state[which], nominal[which], hazards[which], near)
            now = self._retained(new.action, which, state, hazards, model, near)
            good = ~new.relaxed & (now >= -_TOLERANCE)
            better = good | ((now > retained) & (relaxed[which] | ~new.relaxed))
            action[which[better]], relaxed[which[better]] = new.action[better], new.relaxed[better]
            moves = np.abs(action[which] - about).max(axis=1) > _SETTLED
            which, retained, about = which[moves], np.where(better, now, retained)[moves], action[which[moves]]
        return FilteredActions(action, np.any(action != nominal, axis=1), relaxed)

    def _retained(
        self,
        action: FloatArray,
        which: IndexArray,
        state: FloatArray,
        hazards: FloatArray,
        model: ActionModel,
        believed: PointPrediction,
    ) -> FloatArray:
        """min over hazards of h(next) - (1 - eta) h - epsilon (n,) [m], by the model itself: below 0 it falls short."""
        around = around_hazards(hazards[which], believed.motion)
        following = model.following(action, which)
        retained: FloatArray = (around.h(following) - (1.0 - ETA) * around.h(state[which])).min(axis=1)
        return retained - self._epsilon
