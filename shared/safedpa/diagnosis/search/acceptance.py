"""Acceptance: when a trial is accepted, which others the data cannot distinguish from it, and the reasons as text.

A trial that unseen blocks favour is confirmed by the filter along whole recordings. Windows restart, so they do not
know lasting disturbances. A driver who watches the robot counteracts such a disturbance, and the command that does so
looks like a command with too little effect (feedback correlates input and disturbance). The gain on unseen blocks does
not reveal that, because every block has the same driver. The filter estimates lasting disturbances, so its values are
not biased by the driver. If the two estimates differ widely, the windows' value comes from the feedback.

Source: Ljung, System Identification, 2nd ed., 1999, sections 13.4 and 13.5 (feedback in the data); Hausman,
Econometrica 46, 1978 (an efficient estimate compared with a consistent one); Holm, Scandinavian Journal of Statistics
6, 1979 (many tests at once).
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
from safedpa.diagnosis.fit.trial import EffectTrial, block_gain, explanation_correlation, has_shape_at_bound
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState

CLEAR_GAIN = 8.0
"""Gain on unseen blocks, in standard errors, that needs no confirmation: feedback never gave half of that."""
CLEAR_FALL = 0.15
"""Reduction of the held-out rollout error that needs no confirmation: in ten hard logs feedback gave 0.01 to 0.09."""
MUCH = 0.25
"""Held-out rollout error above which the filter is not used: it would treat missing friction and drag as lasting
disturbances. Hard logs in which nothing is hidden have 0.05 to 0.11."""
HALF = 0.5
"""Share of the windows' value that the filter has to find. In hard logs where an effect acts it found 0.69 to 1.4;
where only a driver acts, 0.28 to 0.5 with one exception."""
LASTING = 4.0
"""Standard deviations from the neutral value that the filter has to find: one in a thousand by chance among 25 effects
(Holm), if values were normal."""
CERTAIN = 9.0
"""Standard deviations of the filter that confirm a trial that is only likely on blocks. In hard logs a battery whose
voltage sags is at 12."""
CORNERED = frozenset({"drive_dead_zone", "steering_saturation", "steering_asymmetry", "backlash"})
"""Effects with a corner: the filter linearises, and its deviation for them is too small to be certain."""
FRICTIONS = frozenset({"coulomb_friction", "stribeck_friction"})
"""Dry frictions of a joint that swings under gravity: it meets their corner at the end of every swing."""
# Rounds of the filter: the third moves parameters by less than a tenth of their deviation.
_ROUNDS = 3


@dataclass(frozen=True)
class _EffectEstimate:
    """Estimates of one effect by windows and by the filter, as changes from the neutral value (parameters,)."""

    windows: FloatArray
    filter: FloatArray
    deviations: FloatArray

    @property
    def distance_in_deviations(self) -> FloatArray:
        """Distance of the filter's value from the neutral one, in standard deviations, (parameters,)."""
        return np.asarray(np.abs(self.filter) / self.deviations)

    @property
    def share_found(self) -> float:
        """Share of the windows' change that the filter finds: sum(w f / s^2) / sum(w^2 / s^2)."""
        weight = self.windows / self.deviations**2
        return float((weight * self.filter).sum() / max(float((weight * self.windows).sum()), 1e-300))


def is_decisive(gain: float, error: HeldoutError | None, before: HeldoutError) -> bool:
    """Returns whether unseen blocks decide alone: they are clear, or too much is missing for the filter."""
    large = error is not None and error.value < (1.0 - CLEAR_FALL) * before.value
    return gain > CLEAR_GAIN or large or before.value > MUCH


def filter_agrees(trial: EffectTrial, search: SearchState) -> bool:
    """Returns whether the filter finds every effect of a trial too, with at least half of its size.

    If the recordings are too short for the filter, unseen blocks decide alone.
    """
    found = prediction_error_fit(trial.fit.model, trial.fit.paths, trial.fit.free, search.shooting.windows, _ROUNDS)
    if found is None:
        return True
    estimates = [_effect_estimate(name, trial, found) for name in trial.effects]
    return all(
        estimate is None or (estimate.share_found >= HALF and bool((estimate.distance_in_deviations > LASTING).any()))
        for estimate in estimates
    )


def filter_is_certain(trial: EffectTrial, search: SearchState) -> bool:
    """Returns whether the filter finds every parameter of a trial CERTAIN standard deviations from its neutral value.

    Parameters without a neutral value do not count, but each effect needs at least one that has it. Effects with a
    corner are never certain.
    """
    if not CORNERED.isdisjoint(trial.effects):
        return False
    found = prediction_error_fit(trial.fit.model, trial.fit.paths, trial.fit.free, search.shooting.windows, _ROUNDS)
    # Without a filter nothing confirms a trial that blocks find only likely.
    if found is None:
        return False
    estimates = [_effect_estimate(name, trial, found) for name in trial.effects]
    return all(
        estimate is not None and bool((estimate.distance_in_deviations > CERTAIN).all()) for estimate in estimates
    )


def _effect_estimate(effect: str, trial: EffectTrial, found: PredictionErrorFit) -> _EffectEstimate | None:
    """Returns both estimates of an effect; None if none of its free parameters has a neutral value."""
    rows = []
    for path, deviation in zip(found.paths, found.deviations.tolist(), strict=True):
        neutral = found.model.parameters[path].neutral
        if path.split(".")[0] == effect and neutral is not None and deviation > 0:
            values = (fitted.settings[path].value - neutral for fitted in (trial.fit.model, found.model))
            rows.append((*values, deviation))
    return _EffectEstimate(*np.array(rows).T) if rows else None


SURE = 3.0
"""Gain on unseen blocks, in standard errors, that an addition needs together with FALL."""
VERY_SURE = 4.5
"""Standard errors that suffice with LITTLE_FALL."""
FALL = 0.03
"""Relative reduction of the held-out rollout error that an addition needs."""
LITTLE_FALL = 0.004
"""The same for an addition with VERY_SURE: small effects can be certain."""
FAIRLY_SURE, LARGE_FALL = 2.0, 0.3
"""The same while MUCH is missing: the few blocks of one log of a slow robot show no more. Chance and feedback by a
driver never reduced an error by a third of that."""
LIKELY = 1.5
"""Standard errors that suffice with FALL if the filter along whole recordings is certain. The filter sees an effect
that grows over a run, for which blocks are too different from each other to agree."""
MOST_MISSING = 0.5
"""Held-out rollout error, relative to the change over the horizon, above which most of the physics is missing."""
SAME = 1.0
"""Standard errors within which two candidates cannot be distinguished."""
SIMPLER = 2.0
"""Standard errors within which the candidate with fewer parameters is preferred."""
ALIKE = 0.9
"""Correlation of what two candidates explain above which they are equivalent, if within SIMPLER."""
SAME_SHAPE = 0.985
"""Correlation above which they are equivalent if within SURE."""
ONE = 0.002
"""Relative squared difference of what two candidates explain below which they are identical."""


@dataclass(frozen=True)
class SearchStage:
    """All trials of one stage, best first, with their gains and held-out errors by effects."""

    number: int
    trials: list[EffectTrial]
    gains: dict[tuple[str, ...], float]
    errors: dict[tuple[str, ...], HeldoutError]
    row: float = 0.0
    """Time between two rows [s]."""
    doubted: frozenset[tuple[str, ...]] = frozenset()
    """Trials that passed, but that the filter along whole recordings did not confirm."""

    def passes(self, trial: EffectTrial, before: HeldoutError) -> bool:
        """Returns whether unseen blocks and the held-out error accept a trial."""
        error = self.errors.get(trial.effects)
        return passes(self.gains[trial.effects], error, before) and not is_spurious_delay(
            trial, error, before, self.row
        )


def passes(gain: float, error: HeldoutError | None, before: HeldoutError) -> bool:
    """Returns whether both the gain on unseen blocks and the reduction of the held-out rollout error suffice."""
    if error is None or not before.value > 0:
        return False
    # Both are required: a significant gain in short windows may not matter over the horizon, and a large fall be
    # chance.
    fall = 1.0 - error.value / before.value
    return (
        (gain > SURE and fall > FALL)
        or (gain > VERY_SURE and fall > LITTLE_FALL)
        or (before.value > MUCH and gain > FAIRLY_SURE and fall > LARGE_FALL)
    )


def is_spurious_delay(trial: EffectTrial, error: HeldoutError | None, before: HeldoutError, row: float) -> bool:
    """Returns whether a trial is a second lag of a command, or one shorter than a row, without a clear gain.

    To first order a lag is a delay. A second one only corrects the shape of the first, which no actuator has exactly.
    A delay shorter than ``row`` [s] cannot be distinguished from the servo's own response.
    """
    # Single effects only: in a pair the reduction may come from the other effect.
    if len(trial.effects) == 1 and error is not None and error.value < (1.0 - CLEAR_FALL) * before.value:
        return False
    model = trial.fit.model
    names = model.system.action_names
    delayed = [delayed_actions(item, names) for item in model.effects if item.name in trial.effects]
    others = [delayed_actions(item, names) for item in model.effects if item.name not in trial.effects]
    # The command already has a lag or delay in the model, given or accepted.
    if any(not one.isdisjoint(other) for one in delayed for other in others):
        return True
    late = [item for item in model.effects if item.name in trial.effects and delayed_actions(item, names)]
    seconds = [model.settings[f"{item.name}.{p.name}"].value for item in late for p in item.parameters if p.unit == "s"]
    return any(value < row for value in seconds)


def is_promising(trial: EffectTrial, stage: SearchStage, before: HeldoutError) -> bool:
    """Returns whether unseen blocks favour a trial enough for a confirmation by the filter."""
    gain, error = stage.gains[trial.effects], stage.errors.get(trial.effects)
    enough = error is not None and gain > LIKELY and error.value < (1.0 - FALL) * before.value
    return enough and not is_spurious_delay(trial, error, before, stage.row)


def simplest_equivalent(trials: Sequence[EffectTrial], search: SearchState) -> EffectTrial | None:
    """Returns the best trial, or the simplest of those that cannot be distinguished from it with certainty."""
    shooting = search.shooting
    # A trial with a larger held-out loss than the current model overfits, whatever its parameters.
    better = [trial for trial in trials if trial.loss < search.current.loss and within_bounds(trial, search)]
    if not better:
        return None
    # The comparison is with the best trial, not with the null: the question is which of two explanations to prefer.
    close = [trial for trial in better[:8] if block_gain(trial, better[0], shooting) < SIMPLER]
    close = close or better[:1]
    fewest = min(len(trial.fit.paths) for trial in close)
    return next(trial for trial in close if len(trial.fit.paths) == fewest)


def order_by_heldout_gain(
    passing: Sequence[EffectTrial], stage: SearchStage, before: HeldoutError
) -> list[EffectTrial]:
    """Puts the trial with a far larger reduction of the held-out error first, while much is missing.

    Windows weight each state by its noise. So a small error of the steering may rank first there while the speed is
    badly wrong.
    """
    # With little missing, the windows' order is the more precise one and is kept.
    if before.value <= MUCH or len(passing) < 2:
        return list(passing)
    least = min(passing, key=lambda trial: stage.errors[trial.effects].value)
    apart = stage.errors[passing[0].effects].value - stage.errors[least.effects].value
    if apart <= CLEAR_FALL * before.value:
        return list(passing)
    return [least, *(trial for trial in passing if trial is not least)]


def fewest_parameters(trial: EffectTrial, trials: Sequence[EffectTrial], search: SearchState) -> EffectTrial:
    """Returns the trial with the fewest parameters among those that explain exactly the same as the given one.

    Example: with a free gain of the base, the mass of a towed load cannot be identified, and only its rolling
    resistance remains. The gains of the two then differ by rounding, and the unidentifiable parameter makes the others
    uncertain.
    """
    fewer = [other for other in trials if len(other.fit.paths) < len(trial.fit.paths) and within_bounds(other, search)]
    same = [other for other in fewer if other.loss < search.current.loss and _identical(trial, other)]
    return min(same, key=lambda other: len(other.fit.paths), default=trial)


def within_bounds(trial: EffectTrial, search: SearchState) -> bool:
    """Returns whether no parameter of the trial's effects is at a bound: what fits only there is another effect.

    While MOST_MISSING, bounds are allowed: effects added later move the value back inside.
    """
    if search.error.value > MOST_MISSING:
        return True
    inside = bool(trial.fit.free[len(search.current.fit.paths) :].all())
    return inside and not has_shape_at_bound(trial, search.shooting)


def judge_trial(
    search: SearchState, stage: SearchStage, trial: EffectTrial, best: EffectTrial | None, passed: bool
) -> JudgedTrial:
    """Returns the verdict on one trial of a stage; ``best`` is the trial that is added if it ``passed``."""
    gain, error = stage.gains[trial.effects], stage.errors.get(trial.effects)
    before, equivalent = search.error.value, _equivalent_free_parameter(trial, search.current)
    if equivalent:
        return JudgedTrial(
            stage.number, trial, gain, error, "rejected", f"the free {equivalent} does the same", (equivalent,), before
        )
    # Below 1.5 standard errors everything resembles everything, and a list of equivalents would mislead.
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
    if trial is best and search.region is not None:
        return "suspected", f"{sentence}; but a region of the floor explains more"
    if trial.effects in stage.doubted:
        return "suspected", f"{sentence}; but a filter that estimates lasting disturbances does not confirm it"
    if passed and best is not None:
        # A trial that nearly ties with the accepted one stays suspected: the data might have preferred it.
        behind = block_gain(trial, best, search.shooting)
        suspected = best.name in equals or (gain > SURE and behind < SIMPLER)
        reason = f"{sentence}; {behind:.1f} standard errors behind {best.name}"
        return ("suspected" if suspected else "rejected"), reason
    if gain > SURE:
        return "suspected", f"{sentence}: the error falls too little to add it"
    return "rejected", sentence


def with_reason(item: JudgedTrial, decision: str, reason: str) -> JudgedTrial:
    """Returns the same trial with another decision and one more reason."""
    return replace(item, decision=decision, reason=f"{item.reason}; {reason}")


def _equals(
    trial: EffectTrial, trials: Sequence[EffectTrial], shooting: Shooting, null: EffectTrial
) -> tuple[str, ...]:
    """Returns the names of the other trials that unseen blocks cannot distinguish from this one."""
    found = []
    for other in trials:
        # Pairs that share an effect with the trial are no alternatives to it.
        if other is trial or other.loss >= null.loss or set(other.effects) & set(trial.effects):
            continue
        # The closer the explanations are correlated, the larger a difference in gain counts as chance.
        apart = abs(block_gain(other, trial, shooting))
        alike = explanation_correlation(other, trial)
        equal = (apart < SAME and alike > 0.5) or (apart < SIMPLER and alike > ALIKE) or _identical(trial, other)
        if equal or (apart < SURE and alike > SAME_SHAPE):
            found.append(other.name)
    return tuple(found)


def _identical(trial: EffectTrial, other: EffectTrial) -> bool:
    """Returns whether both explain the same, including its size: then one has a parameter that is not identifiable."""
    size = float(min((trial.explained**2).sum(), (other.explained**2).sum()))
    return float(((trial.explained - other.explained) ** 2).sum()) < ONE * size


def _equivalent_free_parameter(trial: EffectTrial, null: EffectTrial) -> str:
    """Returns the free parameter that already does what the effect would; empty if there is none."""
    count = len(null.fit.paths)
    if not count or len(trial.effects) > 1:
        return ""
    # Compared to first order: the derivatives of the effect against those of the free parameters.
    flat = trial.fit.columns.reshape(-1, trial.fit.columns.shape[-1])
    known, new = flat[:, :count], flat[:, count:]
    size = float((new**2).sum())
    if not size > 0:
        return ""
    alike = np.abs(known.T @ new) / np.sqrt((known**2).sum(axis=0)[:, None] * (new**2).sum(axis=0) + 1e-30)
    solved = np.linalg.lstsq(known, new, rcond=1e-9)[0]
    left = float(((new - known @ solved) ** 2).sum()) / size
    # The free parameters reproduce the effect up to 0.2 % of its squares: the data cannot separate the two.
    return null.fit.paths[int(alike.max(axis=1).argmax())] if left < 0.002 else ""
