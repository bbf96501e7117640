"""Restarts: the search begins again with several effects that explain more together than the greedy ones did.

Greedy selection ends in a local optimum if the first effect only resembles the sum of two others. So combinations are
fitted jointly (``joint_trials``). One with a lower held-out error than the greedy search had with as many effects is a
new beginning: the rest of the search is repeated from there, and the better of both results stays.

Source: Miller, Subset Selection in Regression, 2nd ed., 2002, ch. 3 (local optima of forward selection).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from safedpa.diagnosis.fit.least_squares import fit
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, block_gain, has_shape_at_bound, ratio_gain, trial_of
from safedpa.diagnosis.search.acceptance import FALL, MUCH, SIMPLER, SURE, passes
from safedpa.diagnosis.search.backward_revision import refit_effects, replace_effects
from safedpa.diagnosis.search.joint_trials import JointTrial, fit_jointly, textbook_combinations
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState, known_effects
from safedpa.effects import AbstractEffect

# Share of the squares that depends on what was driven, from which other beginnings are tried.
_STRUCTURE = 0.1
# Error in units of the usual change below which nothing else is looked for.
_SIZE = 0.01
# Ratio of the residual's mean squares between kinds of driving from which they are, if it is certain.
_SPREAD = 2.5
# Reduction of the held-out error, relative to the greedy search with as many effects, that makes a new beginning.
_BETTER = 0.05
# Refused trials that are tried in the place of an accepted effect.
_REFUSED = 2
# Beginnings from which the search is repeated at most.
_BEGINNINGS = 2
# Ratio of held-out errors up to which two combinations may be equivalent.
_EQUAL_ERROR = 1.5
# Relative difference of held-out errors within which the result with fewer parameters is preferred.
_AS_GOOD = 0.01


def is_open(search: SearchState) -> bool:
    """Returns whether a result asks for other beginnings: much is missing, or the residual depends on the drive."""
    if search.error.value > MUCH or base_at_bound(search):
        return True
    found = search.judge(search.current, search.shooting)
    if found is None:
        return False
    structural = search.error.value * float(np.sqrt(max(found.share, 0.0)))
    depends = found.share > _STRUCTURE and structural > _SIZE
    return depends or (found.spread > _SPREAD and found.spread_errors > SURE and search.error.value > _SIZE)


def base_at_bound(search: SearchState) -> tuple[str, ...]:
    """Returns the free parameters of the base that the first fit left at a bound."""
    fitted = search.first.fit
    return tuple(path for path, free in zip(fitted.paths, fitted.free, strict=True) if not free)


def try_other_beginnings(
    search: SearchState,
    pairs: Callable[[SearchState], Sequence[tuple[AbstractEffect, ...]]],
    complete: Callable[[SearchState], None],
) -> None:
    """Repeats the search from combinations that explain more than its own effects; keeps the better result.

    ``pairs`` proposes combinations for the first model, next to those of textbooks while MUCH is missing. ``complete``
    continues a search to its end.
    """
    if len(search.library) < 2 or search.region is not None or not is_open(search):
        return
    joint = [fit_jointly(search, items) for items in _combinations(search, pairs)]
    for begin in _beginnings(search, joint):
        other = search.restarted()
        _accept(other, begin, joint, search)
        complete(other)
        if is_better(other, search):
            search.continue_from(other)


def exchange_for_refused(search: SearchState) -> None:
    """Exchanges an accepted effect for what it blocks: a refused trial that passes in its place.

    Example: with a delay of all actuators in the model, a lag of each is refused as a second delay of the same command.
    """
    last = max((item.stage for item in search.candidates), default=0)
    refused = [
        item
        for item in search.candidates
        if item.stage == last
        and item.decision == "suspected"
        and item.gain > SURE
        and (item.fall or 0.0) > FALL
        and set(item.trial.effects) <= {effect.name for effect in search.available}
    ]
    by_name = known_effects(search)
    for item in sorted(refused, key=lambda one: -(one.fall or 0.0))[:_REFUSED]:
        new = [by_name[name] for name in item.trial.effects]
        tried = {
            name: refit_effects(search, [*(by_name[other] for other in search.added if other != name), *new])
            for name in search.added
        }
        usable = [name for name, trial in tried.items() if trial.fit.free.all()]
        if not usable:
            continue
        name = min(usable, key=lambda one: tried[one].loss)
        gain = block_gain(search.current, tried[name], search.shooting)
        if passes(gain, search.error_of(tried[name].fit), search.error):
            replace_effects(search, (name,), item.trial.effects, tried[name])
            return


def _combinations(
    search: SearchState, pairs: Callable[[SearchState], Sequence[tuple[AbstractEffect, ...]]]
) -> Iterator[tuple[AbstractEffect, ...]]:
    tried: set[frozenset[str]] = {frozenset(search.added)}
    # The order by first derivatives is reliable about a sound base only.
    common = [item for item in search.library if not item.rare]
    textbook = textbook_combinations(common) if search.first_error.value > MUCH else []
    for items in (*textbook, *pairs(search.restarted())):
        names = frozenset(item.name for item in items)
        if names not in tried:
            tried.add(names)
            yield items


def _beginnings(search: SearchState, joint: Sequence[JointTrial]) -> list[JointTrial]:
    """Returns the combinations that are better than the greedy search was with as many effects, best first."""
    errors = {0: search.first_error.value, **search.least_errors, len(search.added): search.error.value}

    def better(item: JointTrial) -> bool:
        greedy = min(error for count, error in errors.items() if count <= len(item.trial.effects))
        inside = bool(item.trial.fit.free[len(search.first.fit.paths) :].all())
        inside = inside and not has_shape_at_bound(item.trial, item.shooting)
        return inside and item.error.value < (1.0 - _BETTER) * greedy

    return sorted(filter(better, joint), key=lambda item: item.error.value)[:_BEGINNINGS]


def _accept(other: SearchState, begin: JointTrial, joint: Sequence[JointTrial], search: SearchState) -> None:
    """Begins a search with a combination; its candidates are those of the greedy first stage and the combinations."""
    known = [item for item in search.candidates if item.stage == 0 and len(item.trial.effects) == 1]
    why = f"{begin.trial.name}, fitted together, predict unseen data better"
    other.candidates = [
        JudgedTrial(0, item.trial, item.gain, item.error, "rejected", f"{item.reason}; {why}", item.equals, item.before)
        if item.decision == "accepted"
        else item
        for item in known
    ]
    for item in joint:
        gain = gain_over(other.first, item.trial, item.shooting)
        equals = _equal_combinations(begin, joint) if item is begin else ()
        decision, reason = "rejected", f"fitted together: gain on unseen blocks {gain:.1f} standard errors"
        if item is begin:
            decision = "accepted"
        judged = JudgedTrial(0, item.trial, gain, item.error, decision, reason, equals, search.first_error.value)
        other.candidates.append(judged)
    singles = [item.trial.effects[0] for item in known]
    for name in begin.trial.effects:
        other.rivals[name] = [rival for rival in singles if rival not in begin.trial.effects][:12]
    other.added = list(begin.trial.effects)
    other.shooting, other.current, other.error = begin.shooting, begin.trial, begin.error
    other.note_error()


def _equal_combinations(begin: JointTrial, joint: Sequence[JointTrial]) -> tuple[str, ...]:
    """Returns the combinations that unseen blocks do not distinguish from the best one, the closest first."""
    limit = _EQUAL_ERROR * begin.error.value
    near = [item for item in joint if item is not begin and item.error.value < limit]
    same = [
        item
        for item in sorted(near, key=lambda item: item.error.value)
        if not set(item.trial.effects) & set(begin.trial.effects)
        and abs(gain_over(item.trial, begin.trial, begin.shooting)) < SIMPLER
    ]
    return tuple(item.trial.name for item in same)


def gain_over(null: EffectTrial, trial: EffectTrial, shooting: Shooting) -> float:
    """Returns the gain of a trial over a model that is fitted again in the windows about the trial."""
    fitted = fit(null.fit.model, null.fit.paths, shooting, trial.fit.scale)
    again = trial_of(fitted, shooting, (), None)
    return max(block_gain(again, trial, shooting), ratio_gain(again, trial, shooting))


def is_better(other: SearchState, search: SearchState) -> bool:
    """Returns whether another result predicts unseen data clearly better, or as well with fewer parameters."""
    before, after = search.error, other.error
    if after.value <= (1.0 + _AS_GOOD) * before.value and len(other.current.fit.paths) < len(search.current.fit.paths):
        return True
    if not after.value < (1.0 - FALL) * before.value:
        return False
    gain = gain_over(search.current, other.current, other.shooting)
    more = len(other.current.fit.paths) > len(search.current.fit.paths)
    return passes(gain, after, before) if more else gain > SIMPLER
