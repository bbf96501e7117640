"""Backward revision: accepted effects are exchanged for better rivals, and removed where the others suffice.

Source: Miller, Subset Selection in Regression, 2nd ed., 2002, ch. 3 (exchange and backward steps).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from safedpa.diagnosis.fit.cross_validation import HeldoutError
from safedpa.diagnosis.fit.least_squares import fit, known_slopes, regularized_inverse
from safedpa.diagnosis.fit.trial import (
    EffectTrial,
    best_start,
    block_gain,
    explained_by,
    explanation_correlation,
    fit_trials,
    initial_values,
    trial_of,
    with_effect_at,
)
from safedpa.diagnosis.search.acceptance import (
    ALIKE,
    CLEAR_FALL,
    FALL,
    SAME,
    SIMPLER,
    is_spurious_delay,
    passes,
    with_reason,
)
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState, given_effect_names, known_effects
from safedpa.effects import AbstractEffect

# Rivals that are tried in exchange for each accepted effect, best first; each needs a fit.
_RIVALS = 4
# Relative difference of held-out errors that is rounding.
_ROUNDING = 0.002
# One-standard-error rule: the smallest model within one standard error of the best one is preferred. Source: Breiman,
# Friedman, Olshen and Stone, Classification and Regression Trees, 1984, section 3.4.3.
_ONE_STANDARD_ERROR = 1.0
# Distance of the objective at which a rival's fit is abandoned after its first steps: 1 % of the residual.
_ABANDONED = 0.01
# Standard errors, and ratio of errors, from which a model without an effect is so much worse that a rough fit decides.
_CLEARLY_NEEDED, _FAR_WORSE = 4.0, 1.5
# Rivals that a group names besides the accepted effect, the closest ones: a longer list helps no reader.
_MOST_EQUALS = 2
# Ratio of held-out errors from which a rival no longer predicts as well.
_AS_GOOD = 1.1
_NOT_NEEDED = "no longer needed next to the others"
# Accepted effects up to which every effect of the library is tried in the place of each: each needs a stage of fits.
_FEW = 3
# Ratio of held-out errors up to which an effect in the place of another one may be equivalent.
_EQUAL_ERROR = 1.5
# Correlation of their parameters from which two effects are also removed together: each hides the loss of the other.
_CORRELATED = 0.7


def refit_effects(search: SearchState, items: Sequence[AbstractEffect], enough: float = np.inf) -> EffectTrial:
    """Fits the given effects on top of the first model, from the current values or from the starts of new effects.

    The fit is abandoned if its objective stays above ``enough``.
    """
    key = tuple(items)
    if search.refits_of is not search.current:
        search.refits_of = search.current
        search.refits.clear()
    if key in search.refits:
        return search.refits[key]
    fitted = _refitted(search, items, enough)
    if fitted.fit.value <= enough:
        search.refits[key] = fitted
    return fitted


def _refitted(search: SearchState, items: Sequence[AbstractEffect], enough: float) -> EffectTrial:
    now = search.current.fit.model
    known = {item.name for item in now.effects}
    model = search.first.fit.model.with_settings({path: now.settings[path] for path in search.first.fit.paths})
    new_items = []
    for item in items:
        if item.name in known:
            settings = {p.name: now.settings[f"{item.name}.{p.name}"] for p in item.parameters}
            model = model.with_effect(item, settings)
        else:
            new_items.append(item)
    # New effects need starts away from neutral; effects of the current model continue from their values.
    starts = [model]
    for item in new_items:
        starts = [with_effect_at(start, item, values) for start in starts for values in initial_values(item)]
    start = best_start(starts, search.shooting, search.current.fit.scale)
    paths = [*search.first.fit.paths, *(f"{item.name}.{p.name}" for item in items for p in item.parameters)]
    slopes = known_slopes(search.current.fit, paths) if enough < np.inf else None
    found = fit(start, paths, search.shooting, search.current.fit.scale, known=slopes, enough=enough)
    return trial_of(found, search.shooting, (), None)


def exchange_effects(search: SearchState) -> None:
    """Exchanges each accepted effect for a rival that predicts unseen blocks better together with the others."""
    by_name = known_effects(search)
    # With one effect the forward search has already compared all rivals in its place.
    if len(search.added) < 2:
        return
    for name in list(search.added):
        others = [by_name[other] for other in search.added if other != name]
        # Rivals lost to this effect before the others were known; next to them the order may differ.
        rivals = [by_name[other] for other in search.rivals.get(name, []) if other not in search.added][:_RIVALS]
        enough = search.current.fit.value + _ABANDONED
        tried = [refit_effects(search, [*others, rival], enough) for rival in rivals]
        usable = [t for t in tried if t.fit.value <= enough and _justifies_its_parameters(t, search)]
        best = min(usable, key=lambda t: t.loss, default=None)
        if best is None or best.loss >= search.current.loss:
            continue
        new = next(i.name for i in best.fit.model.effects if i.name not in {*search.added, *given_effect_names(search)})
        spurious = is_spurious_delay(replace(best, effects=(new,)), None, search.error, 0.0)
        if block_gain(search.current, best, search.shooting) > SIMPLER and not spurious:
            replace_effects(search, (name,), (new,), best)


def _justifies_its_parameters(trial: EffectTrial, search: SearchState) -> bool:
    """Returns whether each additional parameter improves the log likelihood by at least one (Akaike's criterion).

    A fit of the same rows that is no better cannot predict others better. Example: a towed load with a free gain is a
    rolling resistance whose parameters lie anywhere on a line; gains on blocks then differ by rounding.

    Source: Akaike, IEEE Transactions on Automatic Control 19, 1974.
    """
    more = len(trial.fit.paths) - len(search.current.fit.paths)
    better = float(search.shooting.size.sum()) * (search.current.fit.value - trial.fit.value)
    return more <= 0 or better > more


def replace_effects(search: SearchState, group: Sequence[str], new: Sequence[str], best: EffectTrial) -> None:
    """Replaces accepted effects by others, with which the model is ``best``, and updates the candidates."""
    index = search.added.index(group[0])
    search.added[index : index + 1] = new
    search.added = [name for name in search.added if name not in group]
    search.current = best
    search.error = search.error_of(best.fit)
    new_names, old_names = " and ".join(new), " and ".join(group)
    # The new effects are listed once, with the first candidate that they replace.
    unlisted = tuple(new)
    for item in [item for item in search.candidates if item.decision == "accepted"]:
        if not set(group) & set(item.trial.effects):
            continue
        index = search.candidates.index(item)
        search.candidates[index] = with_reason(item, "rejected", f"replaced by {new_names} once the others were known")
        names = tuple(name for name in item.trial.effects if name not in group) + unlisted
        if names:
            again = EffectTrial(names, best.fit, best.heldout, best.explained, best.loss)
            reason = f"replaces {old_names}"
            search.candidates.insert(
                index, JudgedTrial(item.stage, again, item.gain, search.error, "accepted", reason, ())
            )
        unlisted = ()


def backward_elimination(search: SearchState) -> None:
    """Removes accepted effects, and correlated pairs, without which unseen blocks are predicted as well.

    The least needed goes first, until all are needed. An effect that clearly reduces the held-out error stays even if
    blocks do not confirm it: with few blocks that test has little power.
    """
    by_name = known_effects(search)
    before = list(search.added)
    while len(search.added) > 1:
        without = {}
        for group in _groups(search):
            others = [by_name[name] for name in search.added if name not in group]
            # A rough fit decides the clear cases; a full fit follows only where the effect may be superfluous.
            reduced = refit_effects(search, others, -np.inf)
            if block_gain(reduced, search.current, search.shooting) < _CLEARLY_NEEDED:
                reduced = refit_effects(search, others)
            # A replacement at its bound is not a sufficient model without the group.
            needed = np.inf if _at_new_bound(reduced, search) else block_gain(reduced, search.current, search.shooting)
            without[group] = reduced, needed
        group = min(without, key=lambda names: without[names][1])
        reduced, gain = without[group]
        error = search.error_of(reduced.fit)
        if gain >= SIMPLER or search.error.value < (1.0 - CLEAR_FALL) * error.value:
            break
        _remove(search, group, reduced, error)
    # Only then can the rest depend on what was removed.
    if search.added != before:
        _check_remaining(search)


def select_smallest_model(search: SearchState) -> None:
    """Selects the smallest model within one standard error of the best held-out error, over runs or blocks of one run.

    The least needed effect goes first. All that is removed together may cost at most CLEAR_FALL of the error: runs that
    differ make the standard error large, which does not mean that an effect is useless in each of them. Spurious lags
    are removed too. ``search.without`` then holds the model without each remaining effect.
    """
    by_name = known_effects(search)
    best = search.error.value
    # The limit is relative to the best error before any removal, so small losses cannot add up.
    most = min(best + _ONE_STANDARD_ERROR * search.error.standard_error, best / (1.0 - CLEAR_FALL))
    while len(search.added) > 1:
        search.without = {}
        for name in search.added:
            others = [by_name[other] for other in search.added if other != name]
            reduced = refit_effects(search, others, -np.inf)
            error = search.error_of(reduced.fit)
            if not error.value > _FAR_WORSE * most:
                reduced = refit_effects(search, others)
                error = search.error_of(reduced.fit)
            search.without[name] = reduced, error
        # Spurious lags go first, whatever they seem to contribute.
        spurious = [name for name in search.added if _is_spurious(search, name)]
        can = spurious or [name for name in search.added if not _at_new_bound(search.without[name][0], search)]
        if not can:
            return
        least = min(can, key=lambda name: search.without[name][1].value)
        if (
            not spurious
            and search.without[least][1].value > most
            and _improves_some_run(search.without[least][1], search.error)
        ):
            return
        why = "reduces the error over whole runs by less than one standard error"
        _remove(search, (least,), *search.without[least], why)
    search.without = {}


def _at_new_bound(reduced: EffectTrial, search: SearchState) -> bool:
    """Returns whether the model without an effect is at a bound and the current one is not.

    Another effect then imitates the removed one as far as its bounds allow, so the removed one is needed.
    """
    return bool(search.current.fit.free.all() and not reduced.fit.free.all())


def _is_spurious(search: SearchState, name: str) -> bool:
    """Returns whether an accepted effect is a spurious lag or delay, however it was added."""
    trial, row = replace(search.current, effects=(name,)), float(np.median(search.shooting.windows.period))
    return is_spurious_delay(trial, search.error, search.without[name][1], row)


def _improves_some_run(before: HeldoutError, after: HeldoutError) -> bool:
    """Returns whether some run, or the mean over all, is predicted better."""
    fell = after.by_run < (1.0 - _ROUNDING) * before.by_run
    return bool(fell.any()) or after.value < (1.0 - _ROUNDING) * before.value


def merge_effects(search: SearchState) -> bool:
    """Replaces two accepted effects by one with as many parameters that predicts as well; returns whether it did.

    Example: a payload and a rolling resistance together are exactly a towed load.
    """
    by_name = known_effects(search)
    for pair in combinations(list(search.added), 2):
        others = [by_name[name] for name in search.added if name not in pair]
        for whole in _merged_rivals(search, pair, by_name):
            best = refit_effects(search, [*others, whole])
            if _is_as_good(best, search):
                replace_effects(search, pair, (whole.name,), best)
                return True
    return False


def _merged_rivals(
    search: SearchState, pair: Sequence[str], by_name: Mapping[str, AbstractEffect]
) -> list[AbstractEffect]:
    """Returns the best rivals of two effects that have as many parameters as both together.

    Rivals with fewer parameters are covered by a removal and an exchange, which are tried before.
    """
    parameter_count = sum(len(by_name[name].parameters) for name in pair)
    return [item for name in _rivals(search, pair) if len((item := by_name[name]).parameters) == parameter_count]


def _rivals(search: SearchState, group: Sequence[str]) -> list[str]:
    """Returns the best rivals of accepted effects that are not accepted themselves, each once."""
    # dict.fromkeys removes duplicates and keeps the order, best rivals first.
    names = dict.fromkeys(rival for name in group for rival in search.rivals.get(name, [])[:_RIVALS])
    return [name for name in names if name not in search.added]


def _is_as_good(trial: EffectTrial, search: SearchState) -> bool:
    """Returns whether a trial within its bounds predicts unseen blocks and held-out rollouts as well as the model."""
    # As good means within one standard error, not significantly better: fewer parameters decide then.
    if not trial.fit.free.all() or block_gain(trial, search.current, search.shooting) >= SAME:
        return False
    return search.error_of(trial.fit).value <= (1.0 + _ROUNDING) * search.error.value


def remove_effects_at_bounds(search: SearchState) -> None:
    """Removes accepted effects that are still at a bound of a parameter: what fits only there is another effect."""
    by_name = known_effects(search)
    bound = effects_at_bounds(search.current)
    group = [name for name in search.added if name in bound]
    if group:
        reduced = refit_effects(search, [by_name[name] for name in search.added if name not in group])
        _remove(search, group, reduced, search.error_of(reduced.fit), "fits only at a bound")


def remove_uncertain_effects(search: SearchState, names: Sequence[str]) -> bool:
    """Removes those of some accepted effects whose removal hardly raises the error; returns whether one was removed."""
    removed = False
    by_name = known_effects(search)
    for name in names if len(search.added) > 1 else ():
        others = [by_name[other] for other in search.added if other != name]
        reduced = refit_effects(search, others)
        error = search.error_of(reduced.fit)
        if error.value <= (1.0 + FALL) * search.error.value and not _at_new_bound(reduced, search):
            _remove(search, (name,), reduced, error, "is within two deviations of no effect")
            removed = True
    return removed


def _check_remaining(search: SearchState) -> None:
    """Removes everything if the remaining effects do not pass by themselves: one part of a confirmed pair may not.

    With a clear reduction of the held-out error, the gain that protects an effect from removal is enough.
    """
    null = refit_effects(search, [])
    gain = block_gain(null, search.current, search.shooting)
    before = search.error_of(null.fit)
    clear = gain > SIMPLER and search.error.value < (1.0 - CLEAR_FALL) * before.value
    if not (clear or passes(gain, search.error, before)):
        withdraw_candidates(search, search.added)
        search.added, search.current, search.error = [], search.first, search.first_error


def _groups(search: SearchState) -> list[tuple[str, ...]]:
    """Returns each accepted effect and each pair with correlated parameters, but never all effects."""
    singles = [(name,) for name in search.added]
    fitted = search.current.fit
    covariance = regularized_inverse(np.einsum("wip,wiq->pq", fitted.columns, fitted.columns))
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    owner = np.array([path.split(".")[0] for path in fitted.paths])
    found = []
    for one, other in combinations(search.added, 2):
        part = (covariance / np.outer(size, size))[np.ix_(owner == one, owner == other)]
        # Removing both of two effects would leave the null model, which _check_remaining tests.
        if len(search.added) > 2 and np.abs(part).max(initial=0.0) > _CORRELATED:
            found.append((one, other))
    return [*singles, *found]


def _remove(
    search: SearchState, group: Sequence[str], reduced: EffectTrial, error: HeldoutError, why: str = _NOT_NEEDED
) -> None:
    """Continues with the model without a group of accepted effects."""
    search.added = [name for name in search.added if name not in group]
    search.current, search.error = reduced, error
    withdraw_candidates(search, group, why)


def withdraw_candidates(search: SearchState, group: Sequence[str], why: str = _NOT_NEEDED) -> None:
    """Marks accepted candidates as rejected, with the reason ``why``; a combination keeps its other effects."""
    for index, item in enumerate(search.candidates):
        removed = set(group) & set(item.trial.effects)
        if item.decision == "accepted" and removed:
            reason = f"{' and '.join(sorted(removed))} {why}"
            kept = tuple(name for name in item.trial.effects if name not in removed)
            found = replace(item, trial=replace(item.trial, effects=kept)) if kept else item
            search.candidates[index] = with_reason(found, "accepted" if kept else "rejected", reason)


def exchange_for_fewer_parameters(search: SearchState) -> None:
    """Exchanges one or two accepted effects for as many rivals that predict as well with fewer parameters.

    Such a rival lost by rounding, or because the other effects were not yet in the model. Example: a towed load without
    resistance is a payload.
    """
    by_name = known_effects(search)
    while True:
        found = []
        for group in [group for count in (1, 2) for group in combinations(search.added, count)]:
            best = _best_instead(search, group, _with_fewer(search, group, by_name), by_name)
            if best is not None and _is_as_good(best[0], search):
                found.append((group, *best))
        if not found:
            return
        group, trial, names = min(found, key=lambda one: one[1].loss)
        replace_effects(search, group, names, trial)


def split_effect(search: SearchState) -> None:
    """Replaces an accepted effect by two of its rivals that pass in its place.

    Example: a delay of all actuators imitated a lag of each. Effects that are then at a bound compensated for the
    mistake and are removed with it.
    """
    by_name = known_effects(search)
    for name in list(search.added):
        if name not in search.added:
            continue  # already removed together with another effect
        best = _best_instead(search, (name,), list(combinations(_rivals(search, (name,)), 2)), by_name)
        if best is None:
            continue
        trial, new = best
        idle = [other for other in search.added if other != name and other in effects_at_bounds(trial)]
        if idle:
            retained = [other for other in search.added if other not in (name, *idle)]
            trial = refit_effects(search, [by_name[item] for item in (*retained, *new)])
        gain = block_gain(search.current, trial, search.shooting)
        if trial.fit.free.all() and passes(gain, search.error_of(trial.fit), search.error):
            replace_effects(search, (name, *idle), new, trial)


def effects_at_bounds(trial: EffectTrial) -> set[str]:
    """Returns the effects of a trial that have a parameter at a bound."""
    return {path.split(".")[0] for path, free in zip(trial.fit.paths, trial.fit.free, strict=True) if not free}


def _with_fewer(
    search: SearchState, group: Sequence[str], by_name: Mapping[str, AbstractEffect]
) -> list[tuple[str, ...]]:
    """Returns combinations of as many rivals with fewer parameters in total."""
    parameter_count = sum(len(by_name[name].parameters) for name in group)
    found = combinations(_rivals(search, group), len(group))
    return [one for one in found if sum(len(by_name[name].parameters) for name in one) < parameter_count]


def _best_instead(
    search: SearchState,
    group: Sequence[str],
    instead: Sequence[tuple[str, ...]],
    by_name: Mapping[str, AbstractEffect],
) -> tuple[EffectTrial, tuple[str, ...]] | None:
    """Returns the best fit with one of the alternatives ``instead`` of ``group``; None if none comes close."""
    others = [by_name[name] for name in search.added if name not in group]
    enough = search.current.fit.value + _ABANDONED
    tried = [(refit_effects(search, [*others, *map(by_name.__getitem__, names)], enough), names) for names in instead]
    near = [(trial, names) for trial, names in tried if trial.fit.value <= enough]
    return min(near, key=lambda pair: pair[0].loss, default=None)


def try_all_instead(search: SearchState) -> None:
    """Tries every common effect in the place of each accepted one; those that are equivalent become members of a group.

    Rivals of a stage are ordered by what they explain next to the effects of that stage. Next to an effect that was
    accepted later, another one may do the same. Example: once the acceleration is limited, a drag and a limit of the
    speed both end at one speed.
    """
    by_name = known_effects(search)
    library = [item for item in search.available if not item.rare]
    for name in search.added if len(search.added) <= _FEW else ():
        others = [by_name[other] for other in search.added if other != name]
        reduced = refit_effects(search, others)
        now = replace(search.current, explained=explained_by(search.current.fit, reduced))
        count = len(by_name[name].parameters)
        trials = _all_instead(search, others, reduced, [item for item in library if item.name != name])
        # In the order of the fits; the first few of a stage would leave no room for them.
        search.rivals[name] = list(dict.fromkeys((*(t.effects[0] for t in trials), *search.rivals.get(name, ()))))
        same = [
            trial.effects[0]
            for trial in trials[:_RIVALS]
            if len(by_name[trial.effects[0]].parameters) == count and _is_indistinguishable(trial, now, search)
        ]
        for index, item in enumerate(search.candidates):
            if item.decision == "accepted" and name in item.trial.effects:
                equals = tuple(dict.fromkeys((*item.equals, *same)))[:_MOST_EQUALS]
                search.candidates[index] = replace(item, equals=equals)


def _all_instead(
    search: SearchState, others: Sequence[AbstractEffect], reduced: EffectTrial, library: Sequence[AbstractEffect]
) -> list[EffectTrial]:
    """Returns the trials of a library next to ``others`` that predict better than these alone, best first.

    Each is fitted from the values of ``others`` and of the base without it, and from the present values: without an
    effect that they need, others end far from where they belong. Example: a servo is stiffer if its speed is limited.
    """
    # The first stage has fitted each effect by itself.
    apart = fit_trials(reduced, library, search.shooting, {}) if others else []
    found = {trial.effects[0]: trial for trial in apart}
    enough = search.current.fit.value + _ABANDONED
    for item in library:
        trial = refit_effects(search, [*others, item], enough)
        if item.name not in found or trial.loss < found[item.name].loss:
            explained = explained_by(trial.fit, reduced)
            found[item.name] = replace(trial, effects=(item.name,), explained=explained)
    return sorted((trial for trial in found.values() if trial.loss < reduced.loss), key=lambda trial: trial.loss)


def _is_indistinguishable(trial: EffectTrial, now: EffectTrial, search: SearchState) -> bool:
    """Returns whether unseen blocks and folds do not tell a trial from the current model, and both explain the same."""
    gain, alike = block_gain(trial, now, search.shooting), explanation_correlation(trial, now)
    if not trial.fit.free.all() or not ((gain < SAME and alike > 0.5) or (gain < SIMPLER and alike > ALIKE)):
        return False
    error = search.error_of(trial.fit)
    apart = error.by_fold - search.error.by_fold
    apart = apart[np.isfinite(apart)]
    chance = SIMPLER * float(apart.std(ddof=1)) / np.sqrt(len(apart)) if len(apart) > 1 else 0.0
    return error.value < _EQUAL_ERROR * search.error.value and float(apart.mean()) <= chance


def mark_equivalent_rivals(search: SearchState) -> None:
    """Marks which rivals of each accepted effect predict the same in its place, once all other effects are known.

    Example: once a payload is in the model, a command gain may turn out to be equivalent to a drag. Rivals of an
    earlier stage that are clearly worse next to the other effects are no longer named. The closest are named, so that a
    group has at most three members.
    """
    by_name = known_effects(search)
    for name in search.added:
        parameter_count = len(by_name[name].parameters)
        same: list[str] = []
        for rival in _rivals(search, (name,)) if len(search.added) > 1 else ():
            if len(by_name[rival].parameters) == parameter_count:
                trial = _best_instead(search, (name,), [(rival,)], by_name)
                same += [rival] if trial is not None and _is_as_good(trial[0], search) else []
        for index, item in enumerate(search.candidates):
            if item.decision == "accepted" and name in item.trial.effects:
                equals = dict.fromkeys((*same, *_still_equal(search, item, by_name)))
                search.candidates[index] = replace(item, equals=tuple(equals)[:_MOST_EQUALS])


def _still_equal(search: SearchState, item: JudgedTrial, by_name: Mapping[str, AbstractEffect]) -> list[str]:
    """Returns the rivals of a trial's own stage that predict as well in its place in the final model, best first."""
    if set(item.trial.effects) == set(search.added):
        return list(item.equals)
    found = []
    for rival in item.equals:
        names = tuple(rival.split(" + "))
        if set(names) & set(search.added) or not set(names) <= set(by_name):
            continue
        others = [by_name[name] for name in search.added if name not in item.trial.effects]
        trial = refit_effects(search, [*others, *(by_name[name] for name in names)])
        error = search.error_of(trial.fit).value
        if block_gain(trial, search.current, search.shooting) < SIMPLER and error < _AS_GOOD * search.error.value:
            found.append((error, rival))
    return [rival for _, rival in sorted(found)]
