"""Which effects are missing: additions while unseen blocks of time confirm them, exchanges, removals.

Source: the statistics that decide are those of cross-validation over independent blocks (Arlot and Celisse, Statistics
Surveys 4, 2010); forward and backward steps as in Miller, Subset Selection in Regression, 2nd ed., 2002, ch. 3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from safedpa.diagnosis.fit.evidence import Evidence
from safedpa.diagnosis.fit.heldout import Heldout, HeldoutError, error_with
from safedpa.diagnosis.fit.shooting import Shooting
from safedpa.diagnosis.fit.trial import Trial, block_gain, tried_in_turn
from safedpa.diagnosis.search.acceptance import accept, settled
from safedpa.diagnosis.search.beginning import begun
from safedpa.diagnosis.search.conditions import conditional, of_patch, placed
from safedpa.diagnosis.search.final_numbers import with_final_numbers, with_form_in_doubt
from safedpa.diagnosis.search.judgement import (
    MOST_MISSING,
    Stage,
    farthest,
    inside,
    judged,
    likely,
    plainest,
    preferred,
)
from safedpa.diagnosis.search.patch import Patch, best_patch
from safedpa.diagnosis.search.progress import Judged, Search
from safedpa.diagnosis.search.revision import (
    bounded,
    exchange,
    fewer_numbers,
    removals,
    same_at_last,
    smallest,
    split,
    united,
)
from safedpa.diagnosis.search.second_opinion import CLEAR_FALL, MUCH, agrees, certain, clear
from safedpa.diagnosis.search.where_none_passes import Passing, one_step_ahead, pairs_of, passing_elsewhere, worth_it
from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect

__all__ = ["Judged", "Search", "Tell", "accept", "addition", "searched"]

MOST = 12
"""Additions."""
_ASKED = 3
"""Trials of one stage that the filter along whole recordings is asked about at most."""

_SETTLED = 4
"""Trials of one stage that are fitted about their own model while MUCH is missing."""

Tell = Callable[[int, int, str], None]
"""(done, of how many, what is looked for and the best that is known so far): of this stage, for nobody knows how many
will follow."""
Beside = Callable[[], Iterable[Evidence]]
"""Makes the same recordings at other horizons; asked only where one horizon leaves a question open."""


def searched(
    model: PhysicsModel,
    library: Sequence[AbstractEffect],
    shooting: Shooting,
    heldout: Heldout,
    tell: Tell = lambda _done, _all, _said: None,
    beside: Beside = lambda: (),
) -> Search:
    """Free parameters refitted, then additions until nothing passes, second thoughts, and the final numbers."""
    search = begun(model, shooting, heldout)
    _additions(search, library, heldout, tell, beside)
    tell(0, 3, f"second thoughts about all that was added; {_so_far(search)}")
    _second_thoughts(search, library, heldout)
    tell(1, 3, f"where and when it acts; {_so_far(search)}")
    if library and conditional(search, library, heldout):
        _additions(search, library, heldout, tell, beside)  # a law may lay bare what it hid
        _second_thoughts(search, library, heldout)
    tell(2, 3, f"final numbers; {_so_far(search)}")
    if library:
        final, search.error = with_final_numbers(search.current.fit, search.shooting, heldout)
        search.current = replace(search.current, fit=with_form_in_doubt(final, search))
    return search


def _additions(search: Search, library: Sequence[AbstractEffect], heldout: Heldout, tell: Tell, beside: Beside) -> None:
    """One effect after the other, until none passes; while MUCH is missing then, one step further."""
    _added_in_turn(search, library, heldout, tell, beside)
    while search.error.value > MUCH:
        ahead = one_step_ahead(search, heldout)
        if ahead is None:
            return
        _added_in_turn(ahead, library, heldout, tell, beside)
        if not worth_it(search, ahead, library):
            return
        search.take(ahead)


def _added_in_turn(
    search: Search, library: Sequence[AbstractEffect], heldout: Heldout, tell: Tell, beside: Beside
) -> None:
    """One effect after the other, until none passes."""
    before: dict[str, Trial] = {}
    first = 1 + max((item.stage for item in search.candidates), default=-1)
    for stage in range(first, MOST if library else 0):
        rest = [item for item in library if item.name not in {own.name for own in search.current.fit.model.effects}]
        trials = tried_in_turn(
            search.current, rest, search.shooting, before, _stage_told(tell, search, stage, len(rest))
        )
        before = {trial.effects[0]: trial for trial in trials}
        if not addition(search, stage, trials, rest, heldout, beside):
            break


def _second_thoughts(search: Search, library: Sequence[AbstractEffect], heldout: Heldout) -> None:
    """Exchanges, and what the others do without."""
    exchange(search, library, heldout)
    split(search, library, heldout)
    removals(search, library, heldout)
    fewer_numbers(search, library, heldout)
    if united(search, library, heldout):
        removals(search, library, heldout)  # what took the place of two may do what a third did
    smallest(search, library, heldout)
    if search.first_error.value > MOST_MISSING:
        bounded(search, library, heldout)
    same_at_last(search, library, heldout)


def _stage_told(tell: Tell, search: Search, stage: int, size: int) -> Callable[[int], None]:
    """Tells how much of a stage is done."""
    said = f"stage {stage + 1} of at most {MOST}; {_so_far(search)}"
    return lambda done: tell(done, size, said)


def _so_far(search: Search) -> str:
    """The best sentence so far."""
    if not search.added:
        return f"so far nothing is found missing, error {search.first_error.value:.3g}"
    names = ", ".join(search.added)
    return f"so far missing: {names}, error {search.first_error.value:.3g} to {search.error.value:.3g}"


def addition(
    search: Search,
    number: int,
    trials: list[Trial],
    rest: Sequence[AbstractEffect],
    heldout: Heldout,
    beside: Beside = lambda: (),
) -> bool:
    """Judges the trials of a stage; adds the best that passes and says whether there was one."""
    null, shooting = search.current, search.shooting
    stage = _stage(search, number, trials, heldout)
    best, passed, doubted = _best(search, stage)
    if not passed:
        pairs = pairs_of(null, trials, rest, shooting)
        two = _stage(search, number, pairs, heldout, at_most=len(pairs))
        good = [t for t in pairs if inside(t, search) and two.passes(t, search.error)]
        good = farthest(sorted(good, key=lambda trial: trial.loss), two, search.error)
        chosen, refused = _agreed(search, two, good)
        chosen = _far_better(search, two, chosen) or chosen
        best, passed, doubted = chosen or best, chosen is not None, doubted | refused
        every = sorted([*trials, *pairs], key=lambda trial: trial.loss)
        stage = Stage(number, every, stage.gains | two.gains, stage.errors | two.errors, stage.row)
    stage = replace(stage, doubted=doubted)
    if not passed and best is not None and best.effects not in doubted and likely(best, stage, search.error):
        passed = certain(best, search)
    elsewhere = None if passed else passing_elsewhere(search, stage, rest, beside)
    if elsewhere is not None:
        best, passed = elsewhere.trial, True
    if passed and best is not None:
        best = plainest(best, stage.trials, search)
        search.patch = _place_instead(null, best, shooting)
        passed = search.patch is None
    search.candidates += [_with(elsewhere, judged(search, stage, trial, best, passed)) for trial in stage.trials]
    floor = None if search.patch is None else of_patch(search.patch, search, rest)
    if floor is not None:
        return placed(search, floor, number, heldout)
    if not passed or best is None:
        return False
    for name in best.effects:
        singles = [trial.effects[0] for trial in stage.trials if len(trial.effects) == 1]
        search.rivals[name] = [other for other in singles if other not in best.effects][:12]
    accept(search, best, heldout)
    return True


def _with(elsewhere: Passing | None, item: Judged) -> Judged:
    """The verdict on a trial, with what another horizon says about it."""
    if elsewhere is None or item.trial is not elsewhere.trial:
        return item
    return replace(item, reason=f"{item.reason}; {elsewhere.reason}")


def _stage(search: Search, number: int, trials: list[Trial], heldout: Heldout, at_most: int = 6) -> Stage:
    """Gains of all trials, held-out errors of the ``at_most`` best that gain anything."""
    gains = {trial.effects: block_gain(search.current, trial, search.shooting) for trial in trials}
    close = [trial for trial in trials if gains[trial.effects] > 1.0][:at_most]
    errors: dict[tuple[str, ...], HeldoutError] = {}
    for trial in close:
        shooting, own = search.shooting, trial.fit
        if search.error.value > MUCH and len(errors) < _SETTLED:
            shooting, own = settled(trial, shooting)
        errors[trial.effects] = error_with(own, shooting, heldout)
    return Stage(number, trials, gains, errors, float(np.median(search.shooting.windows.period)))


def _best(search: Search, stage: Stage) -> tuple[Trial | None, bool, frozenset[tuple[str, ...]]]:
    """The single effect that is to be added, or the best one; whether it passed; and what passed but is doubted."""
    best = preferred(stage.trials, search)
    # the one that takes most off the windows may not help over the horizon: then another that does
    others = [t for t in stage.trials if t is not best and t.effects in stage.errors and inside(t, search)]
    passing = [trial for trial in ([best] if best else []) + others if stage.passes(trial, search.error)]
    passing = farthest(passing, stage, search.error)
    chosen, doubted = _agreed(search, stage, passing)
    return chosen or best, chosen is not None, doubted


def _far_better(search: Search, stage: Stage, chosen: Trial | None) -> Trial | None:
    """A pair that blocks find likely only, but that takes far more off the held-out error than the chosen one, and of
    which the filter is certain."""
    error = search.error if chosen is None else stage.errors[chosen.effects]
    enough = error.value - CLEAR_FALL * search.error.value
    open_ones = [
        trial
        for trial in stage.trials
        if trial is not chosen
        and inside(trial, search)
        and likely(trial, stage, search.error)
        and stage.errors[trial.effects].value < enough
    ]
    best = min(open_ones, key=lambda trial: stage.errors[trial.effects].value, default=None)
    return best if best is not None and certain(best, search) else None


def _agreed(search: Search, stage: Stage, passing: Sequence[Trial]) -> tuple[Trial | None, frozenset[tuple[str, ...]]]:
    """The first of some trials that passed which is clear or which the filter confirms, and those refused before it."""
    refused: list[tuple[str, ...]] = []
    for trial in passing[:_ASKED]:
        sure = clear(stage.gains[trial.effects], stage.errors.get(trial.effects), search.error)
        if sure or agrees(trial, search):
            return trial, frozenset(refused)
        refused.append(trial.effects)
    return None, frozenset(refused)


def _place_instead(null: Trial, best: Trial, shooting: Shooting) -> Patch | None:
    """A patch of the plane that explains the residual better than the effect, and goes on explaining beside it."""
    patch = best_patch(null, shooting)
    if patch is None or not patch.beats(best, shooting):
        return None
    return patch
