"""Forward selection of missing effects: additions that unseen blocks of time confirm, then exchanges and removals.

``further_trials`` has what is tried if no single effect passes.

Source: the statistics that decide are those of cross-validation over independent blocks (Arlot and Celisse, Statistics
Surveys 4, 2010); forward and backward steps and sequential replacement as in Miller, Subset Selection in Regression,
2nd ed., 2002, ch. 3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from safedpa.diagnosis.fit.cross_validation import Heldout, HeldoutError, error_with
from safedpa.diagnosis.fit.least_squares import relinearized
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, block_gain, fit_trials, ratio_gain
from safedpa.diagnosis.search.acceptance import (
    CLEAR_FALL,
    MOST_MISSING,
    MUCH,
    SearchStage,
    fewest_parameters,
    filter_agrees,
    filter_is_certain,
    is_decisive,
    is_promising,
    judge_trial,
    order_by_heldout_gain,
    simplest_equivalent,
    within_bounds,
)
from safedpa.diagnosis.search.backward_revision import (
    backward_elimination,
    exchange_effects,
    exchange_for_fewer_parameters,
    mark_equivalent_rivals,
    merge_effects,
    remove_effects_at_bounds,
    remove_uncertain_effects,
    select_smallest_model,
    split_effect,
    try_all_instead,
)
from safedpa.diagnosis.search.conditional import accept_law, add_conditions, region_effect
from safedpa.diagnosis.search.final_parameters import (
    uncertain_effects,
    with_final_values,
    with_model_uncertainty,
    with_timing_uncertainty,
)
from safedpa.diagnosis.search.further_trials import (
    OtherHorizons,
    fit_pairs,
    improves_clearly,
    look_one_step_ahead,
    passing_at_other_horizon,
    promising_pairs,
    rare_effects,
    timing_explains_more,
)
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.diagnosis.search.regions import best_region
from safedpa.diagnosis.search.restarts import exchange_for_refused, is_open, try_other_beginnings
from safedpa.diagnosis.search.search_state import RemainderJudge, SearchState, accept_trial, no_remainder
from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect

MOST = 12
"""Effects that are added at most."""
# Trials of one stage that are confirmed with the filter at most: each takes as long as several fits.
_CONFIRMED_TRIALS = 3
# Trials of one stage that are relinearised while MUCH is missing: the first order is poor only for large effects.
_RELINEARISED_TRIALS = 4

# Changes of the time at which commands are taken to change: to between the rows, and back.
_SWITCHES = 2

ReportProgress = Callable[[int, int, str], None]
"""Called with (done, total, message) of the current stage; how many stages follow is unknown."""


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
    try_other_beginnings(search, promising_pairs, complete)
    if len(search.library) < len(library) and is_open(search):
        # Rare effects look like common ones to first order, so they are tried for what the common ones leave.
        search.library = library
        complete(search)
        try_other_beginnings(search, rare_effects, complete)
    report_progress(1, 3, f"where and when they act; {_so_far(search)}")
    if library and add_conditions(search):
        # A law explains part of the residual, which may reveal an effect that was hidden before.
        _add_effects(search, report_progress, other_horizons)
        _revise(search)
    report_progress(2, 3, f"final parameters; {_so_far(search)}")
    if library:
        try_all_instead(search)
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
    switches = 0
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
        null = search.copy()
        if not add_best_trial(search, stage, trials, other_horizons):
            break
        if timing_explains_more(null, search) and switches < _SWITCHES:
            search.continue_from(null)
            search.set_timing(between_rows=not search.between_rows)
            switches += 1
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
