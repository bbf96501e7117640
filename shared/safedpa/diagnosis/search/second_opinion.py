"""A second opinion on a trial that unseen blocks favour, from the filter along whole recordings.

Windows start anew, so a lasting push is unknown to them. A driver who watches the robot answers such a push: the
command that goes against it is then mistaken for a command that does too little (feedback makes input and disturbance
depend on each other). The gain on unseen blocks does not show that, for every block has the same driver. The filter
knows lasting pushes, so its numbers do not follow the driver: where the two ways differ widely, the windows' numbers
come from the feedback and not from the effect.

Source: Ljung, System Identification, 2nd ed., 1999, sections 13.4 and 13.5 (feedback in the data); Hausman,
Econometrica 46, 1978 (an efficient estimate held against a consistent one); Holm, Scandinavian Journal of Statistics 6,
1979 (many tests at once).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from safedpa.compare.windows import Floats
from safedpa.diagnosis.fit.heldout import HeldoutError
from safedpa.diagnosis.fit.refinement import Refined, refined
from safedpa.diagnosis.fit.trial import Trial
from safedpa.diagnosis.search.progress import Search

__all__ = ["CERTAIN", "CLEAR_FALL", "CORNERED", "FRICTIONS", "MUCH", "agrees", "certain", "clear"]

CLEAR_GAIN = 8.0
"""Standard errors of gain on unseen blocks from which nobody else is asked: feedback was not seen to give half."""
CLEAR_FALL = 0.15
"""Share off the held-out rollout error from which nobody else is asked: in ten hard logs feedback gave 0.01 to 0.09."""
MUCH = 0.25
"""Held-out rollout error from which the filter has no say: while that much is missing, it takes friction and drag
themselves for lasting pushes. Hard logs in which nothing is hidden have 0.05 to 0.11."""
HALF = 0.5
"""Share of the windows' number that the filter has to leave. In hard logs where an effect acts it left 0.69 to 1.4, in
those where nothing does but a driver, 0.28 to 0.5 with one exception."""
LASTING = 4.0
"""Standard deviations by which the filter has to put a number away from doing nothing: one in a thousand among 25
effects (Holm), were they normal."""
CERTAIN = 9.0
"""Standard deviations that confirm what blocks find likely only: in hard logs it puts a sagging battery at 12."""
CORNERED = frozenset({"drive_dead_zone", "steering_saturation", "steering_asymmetry", "backlash"})
"""Effects with a corner: the filter linearises and states too small a deviation for them, so it is never certain."""
FRICTIONS = frozenset({"coulomb_friction", "stribeck_friction"})
"""Dry frictions of a joint that turns about with gravity: their corner is met at every swing's end."""
_ROUNDS = 3
"""Of the filter: the third moves numbers by less than a tenth of their deviation."""


@dataclass(frozen=True)
class _Numbers:
    """What windows and filter say about one effect: change from doing nothing (parameters,), and the filter's std."""

    windows: Floats
    filter: Floats
    deviations: Floats

    @property
    def away(self) -> Floats:
        """Standard deviations from doing nothing, (parameters,)."""
        return np.asarray(np.abs(self.filter) / self.deviations)

    @property
    def left(self) -> float:
        """Share of the windows' change that the filter leaves: sum(w f / s^2) / sum(w^2 / s^2)."""
        weight = self.windows / self.deviations**2
        return float((weight * self.filter).sum() / max(float((weight * self.windows).sum()), 1e-300))


def clear(gain: float, error: HeldoutError | None, before: HeldoutError) -> bool:
    """Whether unseen blocks decide alone: they are so sure, or so much is missing that the filter has no say."""
    large = error is not None and error.value < (1.0 - CLEAR_FALL) * before.value
    return gain > CLEAR_GAIN or large or before.value > MUCH


def agrees(trial: Trial, search: Search) -> bool:
    """Whether the filter finds every effect of a trial too, and at least half of each.

    Where the recordings are too short for the filter, unseen blocks decide alone.
    """
    found = refined(trial.fit.model, trial.fit.paths, trial.fit.free, search.shooting.windows, _ROUNDS)
    if found is None:
        return True
    every = [_numbers(name, trial, found) for name in trial.effects]
    return all(own is None or (own.left >= HALF and bool((own.away > LASTING).any())) for own in every)


def certain(trial: Trial, search: Search) -> bool:
    """Whether the filter puts every number of a trial CERTAIN standard deviations away from doing nothing.

    Numbers without a value at which they do nothing do not count, but one at least has to be there. Effects with a
    corner are never certain.
    """
    if not CORNERED.isdisjoint(trial.effects):
        return False
    found = refined(trial.fit.model, trial.fit.paths, trial.fit.free, search.shooting.windows, _ROUNDS)
    if found is None:
        return False
    every = [_numbers(name, trial, found) for name in trial.effects]
    return all(own is not None and bool((own.away > CERTAIN).all()) for own in every)


def _numbers(effect: str, trial: Trial, found: Refined) -> _Numbers | None:
    """None where no free number of the effect has a value at which it does nothing."""
    rows = []
    for path, deviation in zip(found.paths, found.deviations.tolist(), strict=True):
        neutral = found.model.parameters[path].neutral
        if path.split(".")[0] == effect and neutral is not None and deviation > 0:
            values = (fitted.settings[path].value - neutral for fitted in (trial.fit.model, found.model))
            rows.append((*values, deviation))
    return _Numbers(*np.array(rows).T) if rows else None
