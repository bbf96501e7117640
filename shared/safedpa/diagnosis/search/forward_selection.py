"""Forward selection of missing effects: additions that unseen blocks of time confirm, then exchanges and removals.

If no single effect passes, three more things are tried:

**Pairs**: the pairs that promise most to first order are fitted.

**Other horizons**: a candidate that unseen blocks favour, but not clearly enough, is fitted and judged again in windows
of 0.5, 0.2 and 2 times the length. Several tests require a higher threshold each (Bonferroni): passing at one of four
horizons with 3.4 standard errors is as rare as passing at one with 3.

**One step ahead**, while much is missing. Recordings that differ from each other (each at one throttle) identify
several effects together. A single effect, fitted without one of the recordings, hardly improves the prediction of that
one. A search that stops there stops by chance, for example at 2.96 standard errors where 3 are required. So the trial
that reduces the error most is added provisionally and the search continues. Its result has to pass as a whole.

Source: the statistics that decide are those of cross-validation over independent blocks (Arlot and Celisse, Statistics
Surveys 4, 2010); several comparisons as in Dunn, Journal of the American Statistical Association 56, 1961; forward and
backward steps and sequential replacement as in Miller, Subset Selection in Regression, 2nd ed., 2002, ch. 3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.diagnosis.fit.cross_validation import Heldout, HeldoutError, error_with
from safedpa.diagnosis.fit.data_checks import HorizonData
from safedpa.diagnosis.fit.least_squares import relinearized
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import (
    EffectTrial,
    block_gain,
    fit_trial,
    fit_trials,
    initial_values,
    ratio_gain,
    trial_of,
    with_effect_at,
)
from safedpa.diagnosis.search.acceptance import (
    CLEAR_FALL,
    FALL,
    LIKELY,
    MOST_MISSING,
    MUCH,
    SURE,
    SearchStage,
    fewest_parameters,
    filter_agrees,
    filter_is_certain,
    is_decisive,
    is_promising,
    is_spurious_delay,
    judge_trial,
    order_by_heldout_gain,
    simplest_equivalent,
    with_reason,
    within_bounds,
)
from safedpa.diagnosis.search.backward_revision import (
    backward_elimination,
    exchange_effects,
    exchange_for_fewer_parameters,
    mark_equivalent_rivals,
    merge_effects,
    refit_effects,
    remove_effects_at_bounds,
    remove_uncertain_effects,
    select_smallest_model,
    split_effect,
)
from safedpa.diagnosis.search.conditional import accept_law, add_conditions, region_effect
from safedpa.diagnosis.search.final_parameters import (
    uncertain_effects,
    with_final_values,
    with_model_uncertainty,
    with_timing_uncertainty,
)
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.diagnosis.search.regions import best_region
from safedpa.diagnosis.search.restarts import exchange_for_refused, is_open, try_other_beginnings
from safedpa.diagnosis.search.search_state import (
    JudgedTrial,
    RemainderJudge,
    SearchState,
    accept_trial,
    known_effects,
    no_remainder,
)
from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect

MOST = 12
"""Effects that are added at most."""
# Trials of one stage that are confirmed with the filter at most: each takes as long as several fits.
_CONFIRMED_TRIALS = 3
# Trials of one stage that are relinearised while MUCH is missing: the first order is poor only for large effects.
_RELINEARISED_TRIALS = 4

ReportProgress = Callable[[int, int, str], None]
"""Called with (done, total, message) of the current stage; how many stages follow is unknown."""
OtherHorizons = Callable[[], Iterable[HorizonData]]
"""Computes the same recordings at other horizons; called only if one horizon leaves a question open."""


def run_search(
    model: PhysicsModel,
    library: Sequence[AbstractEffect],
    shooting: Shooting,
    heldout: Heldout,
    report_progress: ReportProgress = lambda _done, _all, _message: None,
    other_horizons: OtherHorizons = lambda: (),
    judge: RemainderJudge = no_remainder,
) -> SearchState:
    """Refits the free parameters, adds effects until none passes, revises them, adds laws and fits final parameters.

    ``judge`` judges what a model leaves: other beginnings and rare effects are tried for what depends on the drive.
    """
    search = initial_search(model, shooting, heldout)
    search.judge = judge

    def complete(other: SearchState) -> None:
        _add_effects(other, report_progress, other_horizons)
        report_progress(0, 3, f"revising the effects that were added; {_so_far(other)}")
        # Revision comes after all additions: which effect is superfluous is clear only once the others are known.
        exchange_for_refused(other)
        _revise(other)

    search.library = [item for item in library if not item.rare]
    complete(search)
    try_other_beginnings(search, _promising_pairs, complete)
    if len(search.library) < len(library) and is_open(search):
        # Rare effects look like common ones to first order, so they are tried for what the common ones leave.
        search.library = library
        complete(search)
        try_other_beginnings(search, _rare_effects, complete)
    report_progress(1, 3, f"where and when they act; {_so_far(search)}")
    if library and add_conditions(search):
        # A law explains part of the residual, which may reveal an effect that was hidden before.
        _add_effects(search, report_progress, other_horizons)
        _revise(search)
    report_progress(2, 3, f"final parameters; {_so_far(search)}")
    if library:
        _set_final_values(search)
        # Effects whose final values are compatible with no effect go, unless predictions of unseen data need them.
        if remove_uncertain_effects(search, uncertain_effects(search)):
            _set_final_values(search)
    return search


def _set_final_values(search: SearchState) -> None:
    """Replaces parameters and deviations by the final ones."""
    final, search.error = with_final_values(search.current.fit, search.shooting, search.heldout)
    final = with_timing_uncertainty(with_model_uncertainty(final, search), search)
    search.current = replace(search.current, fit=final)


def _add_effects(search: SearchState, report_progress: ReportProgress, other_horizons: OtherHorizons) -> None:
    """Adds effects one after the other until none passes; if MUCH is still missing, looks one step ahead."""
    _add_one_by_one(search, report_progress, other_horizons)
    # Provisional: the steps ahead are kept only if their result passes as a whole.
    while search.error.value > MUCH:
        ahead = look_one_step_ahead(search)
        if ahead is None:
            return
        _add_one_by_one(ahead, report_progress, other_horizons)
        if not improves_clearly(search, ahead):
            return
        search.continue_from(ahead)


def _add_one_by_one(search: SearchState, report_progress: ReportProgress, other_horizons: OtherHorizons) -> None:
    """Adds effects one after the other until none passes."""
    before: dict[str, EffectTrial] = {}
    # Stages continue to count after a law or a step ahead, so that candidates of a stage stay together.
    first = 1 + max((item.stage for item in search.candidates), default=-1)
    most = first + MOST - len(search.added)
    for stage in range(first, most if search.library else first):
        available, notice = search.available, f"stage {stage + 1} of at most {most}; {_so_far(search)}"
        size = len(available)
        report = lambda done, size=size, text=notice: report_progress(done, size, text)  # noqa: E731
        trials = fit_trials(search.current, available, search.shooting, before, report)
        # The fitted values of this stage are starts for the next: adding one effect moves most others little.
        before = {trial.effects[0]: trial for trial in trials}
        if not add_best_trial(search, stage, trials, other_horizons):
            break
        search.note_error()


def _revise(search: SearchState) -> None:
    """Revises the accepted effects: exchanges, splits, merges and removals."""
    exchange_effects(search)
    split_effect(search)
    backward_elimination(search)
    exchange_for_fewer_parameters(search)
    if merge_effects(search):
        # The effect that replaced two may make a third one superfluous.
        backward_elimination(search)
    select_smallest_model(search)
    # Only then were values at a bound accepted (within_bounds); elsewhere there are none to remove.
    if search.first_error.value > MOST_MISSING:
        remove_effects_at_bounds(search)
    mark_equivalent_rivals(search)


def _so_far(search: SearchState) -> str:
    """Returns the result so far as text."""
    if not search.added:
        return f"so far nothing is found missing, error {search.first_error.value:.3g}"
    names = ", ".join(search.added)
    return f"so far missing: {names}, error {search.first_error.value:.3g} to {search.error.value:.3g}"


def add_best_trial(
    search: SearchState,
    number: int,
    trials: list[EffectTrial],
    other_horizons: OtherHorizons = lambda: (),
) -> bool:
    """Judges the trials of a stage and adds the best that passes; returns whether one was added."""
    null, shooting, available = search.current, search.shooting, search.available
    stage = _stage(search, number, trials)
    best, passed, doubted = _choose_effect(search, stage)
    if not passed:
        # Pairs come second: a single effect that passes is the simpler explanation, and pairs take longer to fit.
        pairs = fit_pairs(null, trials, available, shooting)
        two = _stage(search, number, pairs, at_most=len(pairs))
        good = [t for t in pairs if within_bounds(t, search) and two.passes(t, search.error)]
        good = order_by_heldout_gain(sorted(good, key=lambda trial: trial.loss), two, search.error)
        chosen, refused = _first_confirmed(search, two, good)
        # A pair may be far better than the first confirmed one, though blocks alone find it only likely.
        chosen = _far_better(search, two, chosen) or chosen
        best, passed, doubted = chosen or best, chosen is not None, doubted | refused
        every = sorted([*trials, *pairs], key=lambda trial: trial.loss)
        stage = SearchStage(number, every, stage.gains | two.gains, stage.errors | two.errors, stage.row)
    stage = replace(stage, doubted=doubted)
    if not passed and best is not None and best.effects not in doubted and is_promising(best, stage, search.error):
        passed = filter_is_certain(best, search)
    # The last resort, because it refits everything in other windows.
    at_other_horizon = None if passed else passing_at_other_horizon(search, stage, available, other_horizons)
    if at_other_horizon is not None:
        best, passed = at_other_horizon.trial, True
    if passed and best is not None:
        best = fewest_parameters(best, stage.trials, search)
        # A region where the floor brakes looks like several weak effects, so it is compared before one is accepted.
        found = best_region(null, shooting)
        search.region = found if found is not None and found.beats(best, shooting) else None
        passed = search.region is None
    for trial in stage.trials:
        item = judge_trial(search, stage, trial, best, passed)
        if at_other_horizon is not None and trial is at_other_horizon.trial:
            item = replace(item, reason=f"{item.reason}; {at_other_horizon.reason}")
        search.candidates.append(item)
    region_trial = None if search.region is None else region_effect(search.region, search)
    if region_trial is not None:
        accept_law(search, region_trial, number)
        return True
    if not passed or best is None:
        return False
    for name in best.effects:
        singles = [trial.effects[0] for trial in stage.trials if len(trial.effects) == 1]
        # The twelve best of the stage; exchanges use at most a few of them.
        search.rivals[name] = [other for other in singles if other not in best.effects][:12]
    accept_trial(search, best)
    return True


def _stage(search: SearchState, number: int, trials: list[EffectTrial], at_most: int = 6) -> SearchStage:
    """Computes the gains of all trials, and the held-out errors of the ``at_most`` best with a gain above 1."""
    gains = {trial.effects: block_gain(search.current, trial, search.shooting) for trial in trials}
    if search.error.value > MUCH:
        # Most squares then lie in a few blocks, so that their differences show little.
        gains = {
            trial.effects: max(gains[trial.effects], ratio_gain(search.current, trial, search.shooting))
            for trial in trials
        }
    gaining = [trial for trial in trials if gains[trial.effects] > 1.0][:at_most]
    errors: dict[tuple[str, ...], HeldoutError] = {}
    for trial in gaining:
        large = search.error.value > MUCH and len(errors) < _RELINEARISED_TRIALS
        fitted = relinearized(trial.fit, search.shooting) if large else (trial.fit, search.shooting)
        errors[trial.effects] = error_with(*fitted, search.heldout)
    return SearchStage(number, trials, gains, errors, float(np.median(search.shooting.windows.period)))


def _choose_effect(
    search: SearchState, stage: SearchStage
) -> tuple[EffectTrial | None, bool, frozenset[tuple[str, ...]]]:
    """Returns the effect to add, or the best one; whether it passed; and the trials that the filter refused."""
    best = simplest_equivalent(stage.trials, search)
    # The best trial in the windows may not reduce the held-out error over the horizon; another one may.
    others = [t for t in stage.trials if t is not best and t.effects in stage.errors and within_bounds(t, search)]
    passing = [trial for trial in ([best] if best else []) + others if stage.passes(trial, search.error)]
    passing = order_by_heldout_gain(passing, stage, search.error)
    chosen, doubted = _first_confirmed(search, stage, passing)
    return chosen or best, chosen is not None, doubted


def _far_better(search: SearchState, stage: SearchStage, chosen: EffectTrial | None) -> EffectTrial | None:
    """Returns a pair that reduces the held-out error far more than the chosen one, if the filter is certain of it.

    On unseen blocks such a pair need only be likely.
    """
    error = search.error if chosen is None else stage.errors[chosen.effects]
    enough = error.value - CLEAR_FALL * search.error.value
    open_ones = [
        trial
        for trial in stage.trials
        if trial is not chosen
        and within_bounds(trial, search)
        and is_promising(trial, stage, search.error)
        and stage.errors[trial.effects].value < enough
    ]
    best = min(open_ones, key=lambda trial: stage.errors[trial.effects].value, default=None)
    return best if best is not None and filter_is_certain(best, search) else None


def _first_confirmed(
    search: SearchState, stage: SearchStage, passing: Sequence[EffectTrial]
) -> tuple[EffectTrial | None, frozenset[tuple[str, ...]]]:
    """Returns the first passing trial that is decisive or confirmed by the filter, and those refused before it."""
    refused: list[tuple[str, ...]] = []
    for trial in passing[:_CONFIRMED_TRIALS]:
        # The filter is asked only where blocks leave a doubt: it takes longer than the fit.
        sure = is_decisive(stage.gains[trial.effects], stage.errors.get(trial.effects), search.error)
        if sure or filter_agrees(trial, search):
            return trial, frozenset(refused)
        refused.append(trial.effects)
    return None, frozenset(refused)


# Pairs that are fitted at one stage; the order to first order is reliable enough for the best to be among five.
_FITTED_PAIRS = 5
# Rare effects that are fitted from the first model.
_FITTED_RARE = 4
# Standard errors required at another horizon: Bonferroni's correction of 3 for four tests.
_SURE = 3.4
# Standard errors at the search's own horizon below which other horizons are not tried: there is no question open.
_OPEN = 1.0
# Candidates that are tried at other horizons: each needs several fits.
_OPEN_CANDIDATES = 3
_REASON = "alone too small a gain, but accepted together with the effects found after it"


def fit_pairs(
    null: EffectTrial, trials: Sequence[EffectTrial], available: Sequence[AbstractEffect], shooting: Shooting
) -> list[EffectTrial]:
    """Fits the pairs that promise most to first order; returns those better than both of their effects alone."""
    if len(available) < 2:
        return []
    columns, owners = _displacements(null, available, shooting)
    order = _ranked_pairs(null, columns, owners)
    singles = {trial.effects[0]: trial for trial in trials}
    found = []
    for one, other in order[:_FITTED_PAIRS]:
        trial = fit_trial(null, [available[one], available[other]], shooting)
        # A pair no better than one of its effects alone only adds parameters.
        if trial.loss < min(singles[available[one].name].loss, singles[available[other].name].loss):
            found.append(trial)
    return found


def _promising_pairs(search: SearchState) -> list[tuple[AbstractEffect, ...]]:
    """Returns the pairs of effects that promise most to first order about the current model of a search."""
    available = search.available
    columns, owners = _displacements(search.current, available, search.shooting)
    order = _ranked_pairs(search.current, columns, owners)[:_FITTED_PAIRS]
    return [(available[one], available[other]) for one, other in order]


def _rare_effects(search: SearchState) -> list[tuple[AbstractEffect, ...]]:
    """Returns the rare effects one by one, those that reduce the residual of the first model most first."""
    trials = fit_trials(search.current, [item for item in search.available if item.rare], search.shooting, {})
    by_name = {item.name: item for item in search.library}
    return [(by_name[trial.effects[0]],) for trial in trials[:_FITTED_RARE]]


def _displacements(
    null: EffectTrial, available: Sequence[AbstractEffect], shooting: Shooting
) -> tuple[FloatArray, list[int]]:
    """Returns the change of the residual by each effect at each of its starts (n, all starts), and effect indices."""
    columns, owners = [], []
    for index, item in enumerate(available):
        models = [with_effect_at(null.fit.model, item, values) for values in initial_values(item)]
        residuals = shooting.residuals([null.fit.model]) if not models else shooting.residuals(models)
        stacked = np.moveaxis(residuals, 0, -1)
        reduced = shooting.eliminated(stacked, null.fit.scale).reshape(-1, len(models))
        columns.append(reduced - null.fit.residual.reshape(-1, 1))
        owners += [index] * len(models)
    # Single precision halves the memory of what is the largest array of a search; only the order of the pairs depends
    # on it.
    return np.concatenate(columns, axis=1).astype(np.float32), owners


def _ranked_pairs(null: EffectTrial, columns: Any, owners: list[int]) -> list[tuple[int, int]]:
    """Returns pairs of effects, ordered by how many squares of the residual their best two columns explain."""
    target: Any = np.asarray(null.fit.residual.reshape(-1), dtype=np.float32)
    if null.fit.columns.shape[-1]:
        # Free parameters are projected out first: what they can explain is no gain of a pair.
        known, _ = np.linalg.qr(null.fit.columns.reshape(len(target), -1).astype(np.float32))
        columns, target = columns - known @ (known.T @ columns), target - known @ (known.T @ target)
    columns = columns / (np.linalg.norm(columns, axis=0) + 1e-6)
    correlation, gram = -(columns.T @ target), columns.T @ columns
    # Two-column least squares in closed form. The floor keeps nearly parallel columns from promising anything.
    share = np.maximum(1.0 - gram**2, 1e-3)
    both = correlation[:, None] ** 2 + correlation[None] ** 2 - 2 * gram * correlation[:, None] * correlation[None]
    both /= share
    owner = np.array(owners)
    gains: dict[tuple[int, int], float] = {}
    for one, other in combinations(range(int(owner.max()) + 1), 2):
        part = both[np.ix_(owner == one, owner == other)]
        gains[one, other] = float(part.max())
    return sorted(gains, key=lambda pair: -gains[pair])


@dataclass(frozen=True)
class PassingCandidate:
    """A candidate that was accepted at another horizon."""

    trial: EffectTrial
    seconds: float
    gain: float
    """Gain at that horizon, in standard errors."""
    fall: float
    """Relative reduction of the held-out error at that horizon."""

    @property
    def reason(self) -> str:
        """Text for the reason of the candidate."""
        return f"over {self.seconds:.3g} s the gain is {self.gain:.1f} standard errors, the error falls {self.fall:.0%}"


def passing_at_other_horizon(
    search: SearchState,
    stage: SearchStage,
    library: Sequence[AbstractEffect],
    other_horizons: Callable[[], Iterable[HorizonData]],
) -> PassingCandidate | None:
    """Returns the candidate that another horizon confirms most clearly; None if no horizon confirms one."""
    open_ones = _open_candidates(search, stage)
    if not open_ones:
        return None
    by_name = {item.name: item for item in library}
    best: PassingCandidate | None = None
    for evidence in other_horizons():
        again, shooting = relinearized(search.current.fit, evidence.shooting)
        null, data = trial_of(again, shooting, (), None), replace(evidence, shooting=shooting)
        for trial in open_ones:
            found = _fit_at_horizon(trial, null, data, [by_name[name] for name in trial.effects])
            if found.gain > _SURE and found.fall > FALL and (best is None or found.gain > best.gain):
                best = found
    return best if best is not None and filter_agrees(best.trial, search) else None


def _open_candidates(search: SearchState, stage: SearchStage) -> list[EffectTrial]:
    """Returns candidates with some gain and some reduction of the error, those with the largest reduction first."""
    before = search.error.value
    found = [
        trial
        for trial in stage.trials
        if trial.effects in stage.errors
        and trial.effects not in stage.doubted
        and stage.gains[trial.effects] > _OPEN
        and stage.errors[trial.effects].value < (1.0 - FALL) * before
        and not is_spurious_delay(trial, stage.errors[trial.effects], search.error, stage.row)
        and within_bounds(trial, search)
    ]
    return sorted(found, key=lambda trial: stage.errors[trial.effects].value)[:_OPEN_CANDIDATES]


def _fit_at_horizon(
    trial: EffectTrial, null: EffectTrial, data: HorizonData, items: Sequence[AbstractEffect]
) -> PassingCandidate:
    """Fits a candidate at another horizon and computes its gain and its reduction of the held-out error."""
    model = null.fit.model
    for item in items:
        settings = {p.name: trial.fit.model.settings[f"{item.name}.{p.name}"] for p in item.parameters}
        model = model.with_effect(item, settings)
    extended = fit_trial(null, items, data.shooting, [model])
    before = error_with(null.fit, data.shooting, data.heldout).value
    after = error_with(extended.fit, data.shooting, data.heldout).value
    fall = 1.0 - after / before if before > 0 else 0.0
    return PassingCandidate(trial, data.seconds, block_gain(null, extended, data.shooting), fall)


def look_one_step_ahead(search: SearchState) -> SearchState | None:
    """Returns the search with the likeliest trial of its last stage added although it did not pass; None without one.

    Also returns None if a region of the floor explains more than the best trial, because the region is reported
    instead. With a single recording nothing can differ between recordings, so a trial that does not pass is simply too
    weak.
    """
    if search.region is not None or len(search.shooting.windows.names) < 2:
        return None
    last = max((item.stage for item in search.candidates), default=0)
    likely = [item for item in search.candidates if item.stage == last and _is_likely(item, search)]
    if not likely:
        return None
    best = max(likely, key=lambda item: item.fall or 0.0)
    trials = [item.trial for item in search.candidates if item.stage == last]
    plain = fewest_parameters(best.trial, trials, search)
    best = next(item for item in search.candidates if item.stage == last and item.trial is plain)
    known = [with_reason(item, "accepted", _REASON) if item is best else item for item in search.candidates]
    ahead = replace(search.copy(), candidates=known)
    singles = [item.trial.effects[0] for item in likely if len(item.trial.effects) == 1]
    for name in best.trial.effects:
        ahead.rivals[name] = [other for other in singles if other not in best.trial.effects]
    accept_trial(ahead, best.trial)
    return ahead


def _is_likely(item: JudgedTrial, search: SearchState) -> bool:
    """Returns whether unseen blocks favour a trial over the current model and it reduces the error."""
    # The trial belongs to an earlier model and lacks the effects added since.
    if item.before != search.error.value:
        return False
    if item.decision == "accepted" or item.error is None or not within_bounds(item.trial, search):
        return False
    row = float(np.median(search.shooting.windows.period))
    spurious = is_spurious_delay(item.trial, item.error, search.error, row)
    return item.gain > LIKELY and (item.fall or 0.0) > FALL and not spurious


def improves_clearly(search: SearchState, ahead: SearchState) -> bool:
    """Returns whether the step's result predicts unseen blocks clearly better and reduces the error by CLEAR_FALL."""
    if not ahead.error.value < (1.0 - CLEAR_FALL) * search.error.value:
        return False
    by_name = known_effects(ahead)
    without = refit_effects(ahead, [by_name[name] for name in search.added])
    return block_gain(without, ahead.current, ahead.shooting) > SURE
