"""When a trial is accepted, which others the data cannot tell from it, and the sentences that say why.

A second opinion on a trial that unseen blocks favour, from the filter along whole recordings.

Windows restart, so a lasting push is unknown to them. A driver who watches the robot answers such a push: the
command that goes against it is then mistaken for a command that does too little (feedback makes input and disturbance
depend on each other). The gain on unseen blocks does not show that, for every block has the same driver. The filter
knows lasting pushes, so its numbers do not follow the driver: where the two ways differ widely, the windows' numbers
come from the feedback and not from the effect.

Source: Ljung, System Identification, 2nd ed., 1999, sections 13.4 and 13.5 (feedback in the data); Hausman,
Econometrica 46, 1978 (an efficient estimate compared with a consistent one); Holm, Scandinavian Journal of Statistics 6,
1979 (many tests at once).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.actuators import delayed_actions
from safedpa.diagnosis.fit.cross_validation import HeldoutError
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.prediction_error_method import PredictionErrorFit, prediction_error_fit
from safedpa.diagnosis.fit.trial import EffectTrial, block_gain, explanation_correlation
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState

__all__ = [
    "ALIKE",
    "CERTAIN",
    "CLEAR_FALL",
    "CORNERED",
    "FALL",
    "FRICTIONS",
    "LIKELY",
    "LITTLE_FALL",
    "MOST_MISSING",
    "MUCH",
    "SAME",
    "SIMPLER",
    "SURE",
    "VERY_SURE",
    "SearchStage",
    "fewest_parameters",
    "filter_agrees",
    "filter_is_certain",
    "is_decisive",
    "is_promising",
    "is_spurious_delay",
    "judge_trial",
    "order_by_heldout_gain",
    "passes",
    "simplest_equivalent",
    "with_reason",
    "within_bounds",
]

CLEAR_GAIN = 8.0
"""Standard errors of gain on unseen blocks from which no one else is asked: feedback was not seen to give half."""
CLEAR_FALL = 0.15
"""Share off the held-out rollout error from which no one else is asked: in ten hard logs feedback gave 0.01 to 0.09."""
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
class _EffectEstimate:
    """What windows and filter say about one effect: change from doing nothing (parameters,), and the filter's std."""

    windows: FloatArray
    filter: FloatArray
    deviations: FloatArray

    @property
    def away(self) -> FloatArray:
        """Standard deviations from doing nothing, (parameters,)."""
        return np.asarray(np.abs(self.filter) / self.deviations)

    @property
    def left(self) -> float:
        """Share of the windows' change that the filter leaves: sum(w f / s^2) / sum(w^2 / s^2)."""
        weight = self.windows / self.deviations**2
        return float((weight * self.filter).sum() / max(float((weight * self.windows).sum()), 1e-300))


def is_decisive(gain: float, error: HeldoutError | None, before: HeldoutError) -> bool:
    """Whether unseen blocks decide alone: they are so sure, or so much is missing that the filter has no say."""
    large = error is not None and error.value < (1.0 - CLEAR_FALL) * before.value
    return gain > CLEAR_GAIN or large or before.value > MUCH


def filter_agrees(trial: EffectTrial, search: SearchState) -> bool:
    """Whether the filter finds every effect of a trial too, and at least half of each.

    Where the recordings are too short for the filter, unseen blocks decide alone.
    """
    found = prediction_error_fit(trial.fit.model, trial.fit.paths, trial.fit.free, search.shooting.windows, _ROUNDS)
    if found is None:
        return True
    every = [_numbers(name, trial, found) for name in trial.effects]
    return all(own is None or (own.left >= HALF and bool((own.away > LASTING).any())) for own in every)


def filter_is_certain(trial: EffectTrial, search: SearchState) -> bool:
    """Whether the filter puts every number of a trial CERTAIN standard deviations away from doing nothing.

    Numbers without a value at which they do nothing do not count, but one at least has to be there. Effects with a
    corner are never certain.
    """
    if not CORNERED.isdisjoint(trial.effects):
        return False
    found = prediction_error_fit(trial.fit.model, trial.fit.paths, trial.fit.free, search.shooting.windows, _ROUNDS)
    if found is None:
        return False
    every = [_numbers(name, trial, found) for name in trial.effects]
    return all(own is not None and bool((own.away > CERTAIN).all()) for own in every)


def _numbers(effect: str, trial: EffectTrial, found: PredictionErrorFit) -> _EffectEstimate | None:
    """None where no free number of the effect has a value at which it does nothing."""
    rows = []
    for path, deviation in zip(found.paths, found.deviations.tolist(), strict=True):
        neutral = found.model.parameters[path].neutral
        if path.split(".")[0] == effect and neutral is not None and deviation > 0:
            values = (fitted.settings[path].value - neutral for fitted in (trial.fit.model, found.model))
            rows.append((*values, deviation))
    return _EffectEstimate(*np.array(rows).T) if rows else None


SURE = 3.0
"""Standard errors of gain on unseen blocks that an addition needs, together with FALL."""
VERY_SURE = 4.5
"""Standard errors that do with LITTLE_FALL."""
FALL = 0.03
"""Share by which the held-out rollout error has to fall."""
LITTLE_FALL = 0.004
LIKELY = 1.5
"""Standard errors that do with FALL where the filter along whole recordings is certain: it knows lasting disturbances,
so it sees what grows over a run, where blocks are too unlike each other to agree."""
MOST_MISSING = 0.5
"""Held-out rollout error, in units of the change over the horizon, from which most of the physics is missing."""
SAME = 1.0
"""Standard errors within which two candidates cannot be told apart."""
SIMPLER = 2.0
"""Standard errors within which the candidate with fewer parameters is preferred."""
ALIKE = 0.9
"""Correlation of what two candidates explain from which they count as alike, within SIMPLER."""
SAME_SHAPE = 0.985
"""Correlation from which they count as alike within SURE."""
ONE = 0.002
"""Share of the squares of what one explains up to which two candidates differ in nothing."""


@dataclass(frozen=True)
class SearchStage:
    """All trials of one stage, best first, with their gains and held-out errors by effects."""

    number: int
    trials: list[EffectTrial]
    gains: dict[tuple[str, ...], float]
    errors: dict[tuple[str, ...], HeldoutError]
    row: float = 0.0
    """s between two rows."""
    doubted: frozenset[tuple[str, ...]] = frozenset()
    """Trials that passed, but that the filter along whole recordings does not confirm."""

    def passes(self, trial: EffectTrial, before: HeldoutError) -> bool:
        """Whether a trial is to be added by unseen blocks alone."""
        error = self.errors.get(trial.effects)
        return passes(self.gains[trial.effects], error, before) and not is_spurious_delay(
            trial, error, before, self.row
        )


def passes(gain: float, error: HeldoutError | None, before: HeldoutError) -> bool:
    """Enough standard errors on unseen blocks, and enough off the held-out rollout error."""
    if error is None or not before.value > 0:
        return False
    fall = 1.0 - error.value / before.value
    return (gain > SURE and fall > FALL) or (gain > VERY_SURE and fall > LITTLE_FALL)


def is_spurious_delay(trial: EffectTrial, error: HeldoutError | None, before: HeldoutError, row: float) -> bool:
    """Whether a trial makes later what is late already, or late by less than a row, without a clear fall of the error.

    A lag is a delay to first order: the second one of a command corrects the shape of the first, which no actuator has
    exactly. And what happens within a ``row`` [s] may be the servo's own way to answer, inside its loop.
    """
    if len(trial.effects) == 1 and error is not None and error.value < (1.0 - CLEAR_FALL) * before.value:
        return False  # in a pair the other one may take it off
    model = trial.fit.model
    names = model.system.action_names
    own = [delayed_actions(item, names) for item in model.effects if item.name in trial.effects]
    others = [delayed_actions(item, names) for item in model.effects if item.name not in trial.effects]
    if any(not one.isdisjoint(other) for one in own for other in others):
        return True
    late = [item for item in model.effects if item.name in trial.effects and delayed_actions(item, names)]
    seconds = [model.settings[f"{item.name}.{p.name}"].value for item in late for p in item.parameters if p.unit == "s"]
    return any(value < row for value in seconds)


def is_promising(trial: EffectTrial, stage: SearchStage, before: HeldoutError) -> bool:
    """Whether unseen blocks favour a trial enough to ask the filter along whole recordings, which may be certain."""
    gain, error = stage.gains[trial.effects], stage.errors.get(trial.effects)
    enough = error is not None and gain > LIKELY and error.value < (1.0 - FALL) * before.value
    return enough and not is_spurious_delay(trial, error, before, stage.row)


def simplest_equivalent(trials: Sequence[EffectTrial], search: SearchState) -> EffectTrial | None:
    """The best trial, or the simplest of those that cannot be told from it with certainty."""
    shooting = search.shooting
    better = [trial for trial in trials if trial.loss < search.current.loss and within_bounds(trial, search)]
    if not better:
        return None
    close = [trial for trial in better[:8] if block_gain(trial, better[0], shooting) < SIMPLER]
    close = close or better[:1]
    fewest = min(len(trial.fit.paths) for trial in close)
    return next(trial for trial in close if len(trial.fit.paths) == fewest)


def order_by_heldout_gain(
    passing: Sequence[EffectTrial], stage: SearchStage, before: HeldoutError
) -> list[EffectTrial]:
    """While much is missing, the trial that takes far more off the held-out error than the best in the windows first.

    Windows weigh each state by its noise, so a small fault of the steer may lead there while the speed is all
    wrong.
    """
    if before.value <= MUCH or len(passing) < 2:
        return list(passing)
    least = min(passing, key=lambda trial: stage.errors[trial.effects].value)
    apart = stage.errors[passing[0].effects].value - stage.errors[least.effects].value
    if apart <= CLEAR_FALL * before.value:
        return list(passing)
    return [least, *(trial for trial in passing if trial is not least)]


def fewest_parameters(trial: EffectTrial, trials: Sequence[EffectTrial], search: SearchState) -> EffectTrial:
    """Of all trials that explain the very same as one, itself or the one with the fewest numbers.

    A free gain of the base makes a towed load's mass one with its own size: what is left is a rolling resistance. What
    blocks say of the two is rounding, and next to a number that nothing shows no other one's size is told.
    """
    fewer = [other for other in trials if len(other.fit.paths) < len(trial.fit.paths) and within_bounds(other, search)]
    same = [other for other in fewer if other.loss < search.current.loss and _one(trial, other)]
    return min(same, key=lambda other: len(other.fit.paths), default=trial)


def within_bounds(trial: EffectTrial, search: SearchState) -> bool:
    """Whether none of its own parameters was pushed to a bound: what fits only there is something else.

    While MOST_MISSING, a bound is no proof of that: the next effects move the number back inside.
    """
    return search.error.value > MOST_MISSING or bool(trial.fit.free[len(search.current.fit.paths) :].all())


def judge_trial(
    search: SearchState, stage: SearchStage, trial: EffectTrial, best: EffectTrial | None, passed: bool
) -> JudgedTrial:
    """The verdict on one trial of a stage, ``best`` being what is added if it ``passed``."""
    gain, error = stage.gains[trial.effects], stage.errors.get(trial.effects)
    before, taken = search.error.value, _taken_up(trial, search.current)
    if taken:
        return JudgedTrial(
            stage.number, trial, gain, error, "rejected", f"the free {taken} does the same", (taken,), before
        )
    equals = _equals(trial, stage.trials[:10], search.shooting, search.current) if gain > 1.5 else ()
    decision, reason = _decision(search, stage, trial, best, passed, equals)
    return JudgedTrial(stage.number, trial, gain, error, decision, reason, equals, before)


def _decision(
    search: SearchState,
    stage: SearchStage,
    trial: EffectTrial,
    best: EffectTrial | None,
    passed: bool,
    equals: tuple[str, ...],
) -> tuple[str, str]:
    gain, error = stage.gains[trial.effects], stage.errors.get(trial.effects)
    seconds = search.shooting.windows.horizon
    change = "" if error is None else 100 * (error.value / search.error.value - 1)
    fall = "" if error is None else f"; the held-out error after {seconds:.3g} s changes by {change:+.1f} %"
    sentence = f"gain on unseen blocks {gain:.1f} standard errors{fall}"
    if trial is best and passed:
        return "accepted", sentence
    if trial is best and search.patch is not None:
        return "suspected", f"{sentence}; but a place explains more"
    if trial.effects in stage.doubted:
        return "suspected", f"{sentence}; but a filter that knows lasting pushes does not confirm it"
    if passed and best is not None:
        behind = block_gain(trial, best, search.shooting)
        suspected = best.name in equals or (gain > SURE and behind < SIMPLER)
        reason = f"{sentence}; {behind:.1f} standard errors behind {best.name}"
        return ("suspected" if suspected else "rejected"), reason
    if gain > SURE:
        return "suspected", f"{sentence}: too little to be worth it"
    return "rejected", sentence


def with_reason(item: JudgedTrial, decision: str, reason: str) -> JudgedTrial:
    """The same trial, decided again."""
    return replace(item, decision=decision, reason=f"{item.reason}; {reason}")


def _equals(
    trial: EffectTrial, trials: Sequence[EffectTrial], shooting: Shooting, null: EffectTrial
) -> tuple[str, ...]:
    """Names of the other trials that unseen blocks cannot tell from this one."""
    found = []
    for other in trials:
        if other is trial or other.loss >= null.loss or set(other.effects) & set(trial.effects):
            continue
        apart = abs(block_gain(other, trial, shooting))
        alike = explanation_correlation(other, trial)
        equal = (apart < SAME and alike > 0.5) or (apart < SIMPLER and alike > ALIKE) or _one(trial, other)
        if equal or (apart < SURE and alike > SAME_SHAPE):
            found.append(other.name)
    return tuple(found)


def _one(trial: EffectTrial, other: EffectTrial) -> bool:
    """Whether both explain the very same, size and all: then one has a number that nothing here shows."""
    size = float(min((trial.explained**2).sum(), (other.explained**2).sum()))
    return float(((trial.explained - other.explained) ** 2).sum()) < ONE * size


def _taken_up(trial: EffectTrial, null: EffectTrial) -> str:
    """The free parameter that already does what the effect would, empty where there is none."""
    count = len(null.fit.paths)
    if not count or len(trial.effects) > 1:
        return ""
    flat = trial.fit.columns.reshape(-1, trial.fit.columns.shape[-1])
    known, new = flat[:, :count], flat[:, count:]
    size = float((new**2).sum())
    if not size > 0:
        return ""
    alike = np.abs(known.T @ new) / np.sqrt((known**2).sum(axis=0)[:, None] * (new**2).sum(axis=0) + 1e-30)
    solved = np.linalg.lstsq(known, new, rcond=1e-9)[0]
    left = float(((new - known @ solved) ** 2).sum()) / size
    return null.fit.paths[int(alike.max(axis=1).argmax())] if left < 0.002 else ""
