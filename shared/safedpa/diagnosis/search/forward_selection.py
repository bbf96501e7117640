"""Which effects are missing: additions while unseen blocks of time confirm them, exchanges, removals.

Source: the statistics that decide are those of cross-validation over independent blocks (Arlot and Celisse, Statistics
Surveys 4, 2010); forward and backward steps as in Miller, Subset Selection in Regression, 2nd ed., 2002, ch. 3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from safedpa.diagnosis.fit.cross_validation import Heldout, HeldoutError, error_with
from safedpa.diagnosis.fit.horizon import HorizonData
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, block_gain, fit_trials
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
from safedpa.diagnosis.search.accepted_trial import accept_trial, relinearized_trial
from safedpa.diagnosis.search.backward_revision import (
    backward_elimination,
    exchange_effects,
    exchange_for_fewer_parameters,
    mark_equivalent_rivals,
    merge_effects,
    remove_effects_at_bounds,
    select_smallest_model,
    split_effect,
)
from safedpa.diagnosis.search.conditional import add_conditions, add_region_effect, region_effect
from safedpa.diagnosis.search.final_parameters import with_final_values, with_model_uncertainty
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.diagnosis.search.pairs import (
    PassingCandidate,
    fit_pairs,
    improves_clearly,
    look_one_step_ahead,
    passing_at_other_horizon,
)
from safedpa.diagnosis.search.regions import RegionFit, best_region
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState
from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect

__all__ = ["JudgedTrial", "ReportProgress", "SearchState", "accept_trial", "add_best_trial", "run_search"]

MOST = 12
"""Additions."""
_ASKED = 3
"""Trials of one stage that the filter along whole recordings is asked about at most."""

_SETTLED = 4
"""Trials of one stage that are fitted about their own model while MUCH is missing."""

ReportProgress = Callable[[int, int, str], None]
"""(done, of how many, what is looked for and the best that is known so far): of this stage, for no one knows how many
will follow."""
Alongside = Callable[[], Iterable[HorizonData]]
"""Makes the same recordings at other horizons; asked only where one horizon leaves a question open."""


def run_search(
    model: PhysicsModel,
    library: Sequence[AbstractEffect],
    shooting: Shooting,
    heldout: Heldout,
    report_progress: ReportProgress = lambda _done, _all, _message: None,
    alongside: Alongside = lambda: (),
) -> SearchState:
    """Free parameters refitted, then additions until nothing passes, second thoughts, and the final numbers."""
    search = initial_search(model, shooting, heldout)
    _additions(search, library, heldout, report_progress, alongside)
    report_progress(0, 3, f"second thoughts about all that was added; {_so_far(search)}")
    _second_thoughts(search, library, heldout)
    report_progress(1, 3, f"where and when it acts; {_so_far(search)}")
    if library and add_conditions(search, library, heldout):
        _additions(search, library, heldout, report_progress, alongside)  # a law may lay bare what it hid
        _second_thoughts(search, library, heldout)
    report_progress(2, 3, f"final numbers; {_so_far(search)}")
    if library:
        final, search.error = with_final_values(search.current.fit, search.shooting, heldout)
        search.current = replace(search.current, fit=with_model_uncertainty(final, search))
    return search


def _additions(
    search: SearchState,
    library: Sequence[AbstractEffect],
    heldout: Heldout,
    report_progress: ReportProgress,
    alongside: Alongside,
) -> None:
    """One effect after the other, until none passes; while MUCH is missing then, one step further."""
    _added_in_turn(search, library, heldout, report_progress, alongside)
    while search.error.value > MUCH:
        ahead = look_one_step_ahead(search, heldout)
        if ahead is None:
            return
        _added_in_turn(ahead, library, heldout, report_progress, alongside)
        if not improves_clearly(search, ahead, library):
            return
        search.take(ahead)


def _added_in_turn(
    search: SearchState,
    library: Sequence[AbstractEffect],
    heldout: Heldout,
    report_progress: ReportProgress,
    alongside: Alongside,
) -> None:
    """One effect after the other, until none passes."""
    before: dict[str, EffectTrial] = {}
    first = 1 + max((item.stage for item in search.candidates), default=-1)
    for stage in range(first, MOST if library else 0):
        rest = [item for item in library if item.name not in {own.name for own in search.current.fit.model.effects}]
        trials = fit_trials(
            search.current, rest, search.shooting, before, _stage_reported(report_progress, search, stage, len(rest))
        )
        before = {trial.effects[0]: trial for trial in trials}
        if not add_best_trial(search, stage, trials, rest, heldout, alongside):
            break


def _second_thoughts(search: SearchState, library: Sequence[AbstractEffect], heldout: Heldout) -> None:
    """Exchanges, and what the others do without."""
    exchange_effects(search, library, heldout)
    split_effect(search, library, heldout)
    backward_elimination(search, library, heldout)
    exchange_for_fewer_parameters(search, library, heldout)
    if merge_effects(search, library, heldout):
        backward_elimination(search, library, heldout)  # what took the place of two may do what a third did
    select_smallest_model(search, library, heldout)
    if search.first_error.value > MOST_MISSING:
        remove_effects_at_bounds(search, library, heldout)
    mark_equivalent_rivals(search, library, heldout)


def _stage_reported(
    report_progress: ReportProgress, search: SearchState, stage: int, size: int
) -> Callable[[int], None]:
    """Tells how much of a stage is done."""
    notice = f"stage {stage + 1} of at most {MOST}; {_so_far(search)}"
    return lambda done: report_progress(done, size, notice)


def _so_far(search: SearchState) -> str:
    """The best sentence so far."""
    if not search.added:
        return f"so far nothing is found missing, error {search.first_error.value:.3g}"
    names = ", ".join(search.added)
    return f"so far missing: {names}, error {search.first_error.value:.3g} to {search.error.value:.3g}"


def add_best_trial(
    search: SearchState,
    number: int,
    trials: list[EffectTrial],
    rest: Sequence[AbstractEffect],
    heldout: Heldout,
    alongside: Alongside = lambda: (),
) -> bool:
    """Judges the trials of a stage; adds the best that passes and says whether there was one."""
    null, shooting = search.current, search.shooting
    stage = _stage(search, number, trials, heldout)
    best, passed, doubted = _best(search, stage)
    if not passed:
        pairs = fit_pairs(null, trials, rest, shooting)
        two = _stage(search, number, pairs, heldout, at_most=len(pairs))
        good = [t for t in pairs if within_bounds(t, search) and two.passes(t, search.error)]
        good = order_by_heldout_gain(sorted(good, key=lambda trial: trial.loss), two, search.error)
        chosen, refused = _agreed(search, two, good)
        chosen = _far_better(search, two, chosen) or chosen
        best, passed, doubted = chosen or best, chosen is not None, doubted | refused
        every = sorted([*trials, *pairs], key=lambda trial: trial.loss)
        stage = SearchStage(number, every, stage.gains | two.gains, stage.errors | two.errors, stage.row)
    stage = replace(stage, doubted=doubted)
    if not passed and best is not None and best.effects not in doubted and is_promising(best, stage, search.error):
        passed = filter_is_certain(best, search)
    elsewhere = None if passed else passing_at_other_horizon(search, stage, rest, alongside)
    if elsewhere is not None:
        best, passed = elsewhere.trial, True
    if passed and best is not None:
        best = fewest_parameters(best, stage.trials, search)
        search.patch = _place_instead(null, best, shooting)
        passed = search.patch is None
    search.candidates += [_with(elsewhere, judge_trial(search, stage, trial, best, passed)) for trial in stage.trials]
    floor = None if search.patch is None else region_effect(search.patch, search, rest)
    if floor is not None:
        return add_region_effect(search, floor, number, heldout)
    if not passed or best is None:
        return False
    for name in best.effects:
        singles = [trial.effects[0] for trial in stage.trials if len(trial.effects) == 1]
        search.rivals[name] = [other for other in singles if other not in best.effects][:12]
    accept_trial(search, best, heldout)
    return True


def _with(elsewhere: PassingCandidate | None, item: JudgedTrial) -> JudgedTrial:
    """The verdict on a trial, with what another horizon says about it."""
    if elsewhere is None or item.trial is not elsewhere.trial:
        return item
    return replace(item, reason=f"{item.reason}; {elsewhere.reason}")


def _stage(
    search: SearchState, number: int, trials: list[EffectTrial], heldout: Heldout, at_most: int = 6
) -> SearchStage:
    """Gains of all trials, held-out errors of the ``at_most`` best that gain anything."""
    gains = {trial.effects: block_gain(search.current, trial, search.shooting) for trial in trials}
    close = [trial for trial in trials if gains[trial.effects] > 1.0][:at_most]
    errors: dict[tuple[str, ...], HeldoutError] = {}
    for trial in close:
        shooting, own = search.shooting, trial.fit
        if search.error.value > MUCH and len(errors) < _SETTLED:
            shooting, own = relinearized_trial(trial, shooting)
        errors[trial.effects] = error_with(own, shooting, heldout)
    return SearchStage(number, trials, gains, errors, float(np.median(search.shooting.windows.period)))


def _best(search: SearchState, stage: SearchStage) -> tuple[EffectTrial | None, bool, frozenset[tuple[str, ...]]]:
    """The single effect that is to be added, or the best one; whether it passed; and what passed but is doubted."""
    best = simplest_equivalent(stage.trials, search)
    # the one that takes most off the windows may not help over the horizon: then another that does
    others = [t for t in stage.trials if t is not best and t.effects in stage.errors and within_bounds(t, search)]
    passing = [trial for trial in ([best] if best else []) + others if stage.passes(trial, search.error)]
    passing = order_by_heldout_gain(passing, stage, search.error)
    chosen, doubted = _agreed(search, stage, passing)
    return chosen or best, chosen is not None, doubted


def _far_better(search: SearchState, stage: SearchStage, chosen: EffectTrial | None) -> EffectTrial | None:
    """A pair that blocks find likely only, but that takes far more off the held-out error than the chosen one, and of
    which the filter is certain."""
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


def _agreed(
    search: SearchState, stage: SearchStage, passing: Sequence[EffectTrial]
) -> tuple[EffectTrial | None, frozenset[tuple[str, ...]]]:
    """The first of some trials that passed which is clear or which the filter confirms, and those refused before it."""
    refused: list[tuple[str, ...]] = []
    for trial in passing[:_ASKED]:
        sure = is_decisive(stage.gains[trial.effects], stage.errors.get(trial.effects), search.error)
        if sure or filter_agrees(trial, search):
            return trial, frozenset(refused)
        refused.append(trial.effects)
    return None, frozenset(refused)


def _place_instead(null: EffectTrial, best: EffectTrial, shooting: Shooting) -> RegionFit | None:
    """A patch of the plane that explains the residual better than the effect, and goes on explaining next to it."""
    patch = best_region(null, shooting)
    if patch is None or not patch.beats(best, shooting):
        return None
    return patch
