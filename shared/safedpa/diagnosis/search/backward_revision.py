"""Second thoughts: accepted effects give way to better rivals, and go where the others do without them.

Source: Miller, Subset Selection in Regression, 2nd ed., 2002, ch. 3 (exchange and backward steps).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from safedpa.diagnosis.fit.cross_validation import Heldout, HeldoutError, error_with
from safedpa.diagnosis.fit.least_squares import fit, known_slopes, objectives, regularized_inverse
from safedpa.diagnosis.fit.trial import EffectTrial, block_gain, initial_values, trial_of, with_effect_at
from safedpa.diagnosis.search.acceptance import CLEAR_FALL, SAME, SIMPLER, is_spurious_delay, passes, with_reason
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState, given_effect_names, known_effects
from safedpa.effects import AbstractEffect

__all__ = [
    "backward_elimination",
    "effects_at_bounds",
    "exchange_effects",
    "exchange_for_fewer_parameters",
    "mark_equivalent_rivals",
    "merge_effects",
    "refit_effects",
    "remove_effects_at_bounds",
    "select_smallest_model",
    "split_effect",
    "withdraw_candidates",
]  # fmt: skip

_EXCHANGED = 4
"""Rivals that each accepted effect is exchanged for."""
_ROUNDING = 0.002
"""Share of a held-out error that is rounding."""
_ONE = 1.0
"""Standard errors of the best model's held-out error within which the smallest is as good.

Source: Breiman, Friedman, Olshen and Stone, Classification and Regression Trees, 1984, section 3.4.3.
"""
_HOPELESS = 0.01
"""Of the objective by which a rival may be behind when its fit has begun: one in 50 of an error."""
_NEEDED, _FAR_WORSE = 4.0, 1.5
"""Standard errors, and times the error, from which what is left without an effect is not fitted to the end."""
_TOGETHER = 0.7
"""Correlation of their fitted numbers from which effects are also taken out together."""


def refit_effects(search: SearchState, items: Sequence[AbstractEffect], enough: float = np.inf) -> EffectTrial:
    """The given effects on top of the first model, from the numbers that the present model has, or from starts.

    Above ``enough`` of the objective the fit is not led to the end.
    """
    key = tuple(items)
    if search.refits_of is not search.current:
        search.refits_of = search.current
        search.refits.clear()
    if key in search.refits:
        return search.refits[key]
    made = _refitted(search, items, enough)
    if made.fit.value <= enough:
        search.refits[key] = made
    return made


def _refitted(search: SearchState, items: Sequence[AbstractEffect], enough: float) -> EffectTrial:
    now = search.current.fit.model
    known = {item.name for item in now.effects}
    model = search.first.fit.model
    for path in search.first.fit.paths:
        model = model.with_settings({path: now.settings[path]})
    fresh = []
    for item in items:
        if item.name in known:
            own = {p.name: now.settings[f"{item.name}.{p.name}"] for p in item.parameters}
            model = model.with_effect(item, own)
        else:
            fresh.append(item)
    starts = [model]
    for item in fresh:
        starts = [with_effect_at(made, item, values) for made in starts for values in initial_values(item)]
    values = (
        objectives(search.shooting.residuals(starts), search.shooting, search.current.fit.scale)
        if len(starts) > 1
        else np.zeros(1)
    )
    paths = [*search.first.fit.paths, *(f"{item.name}.{p.name}" for item in items for p in item.parameters)]
    start = starts[int(np.argmin(values))]
    slopes = known_slopes(search.current.fit, paths) if enough < np.inf else None
    found = fit(start, paths, search.shooting, search.current.fit.scale, known=slopes, enough=enough)
    return trial_of(found, search.shooting, (), None)


def exchange_effects(search: SearchState, library: Sequence[AbstractEffect], heldout: Heldout) -> None:
    """Each accepted effect gives way to a rival that predicts unseen blocks better next to the others."""
    by_name = known_effects(search, library)
    if len(search.added) < 2:
        return
    for name in list(search.added):
        others = [by_name[other] for other in search.added if other != name]
        rivals = [by_name[other] for other in search.rivals.get(name, []) if other not in search.added][:_EXCHANGED]
        enough = search.current.fit.value + _HOPELESS
        tried = [refit_effects(search, [*others, rival], enough) for rival in rivals]
        able = [t for t in tried if t.fit.value <= enough and _uses_its_numbers(t, search)]
        best = min(able, key=lambda t: t.loss, default=None)
        if best is None or best.loss >= search.current.loss:
            continue
        new = next(i.name for i in best.fit.model.effects if i.name not in {*search.added, *given_effect_names(search)})
        late = is_spurious_delay(replace(best, effects=(new,)), None, search.error, 0.0)
        if block_gain(search.current, best, search.shooting) > SIMPLER and not late:
            _replaced(search, (name,), (new,), best, heldout)


def _uses_its_numbers(trial: EffectTrial, search: SearchState) -> bool:
    """Whether a trial with more numbers than the present model fits better by a unit of log likelihood for each.

    What fits the same rows no better predicts others no better: a towed load next to a free gain is a rolling resistance
    with its numbers anywhere on a line, and what blocks say of the two is rounding.

    Source: Akaike, IEEE Transactions on Automatic Control 19, 1974.
    """
    more = len(trial.fit.paths) - len(search.current.fit.paths)
    better = float(search.shooting.size.sum()) * (search.current.fit.value - trial.fit.value)
    return more <= 0 or better > more


def _replaced(
    search: SearchState, group: Sequence[str], new: Sequence[str], best: EffectTrial, heldout: Heldout
) -> None:
    """Accepted effects give way to others, with which the model is ``best``; the candidates say so."""
    place = search.added.index(group[0])
    search.added[place : place + 1] = new
    search.added = [name for name in search.added if name not in group]
    search.current = best
    search.error = error_with(best.fit, search.shooting, heldout)
    come, gone = " and ".join(new), " and ".join(group)
    comers = tuple(new)
    for item in [item for item in search.candidates if item.decision == "accepted"]:
        if not set(group) & set(item.trial.effects):
            continue
        index = search.candidates.index(item)
        search.candidates[index] = with_reason(item, "rejected", f"gave way to {come} once the others were known")
        names = tuple(name for name in item.trial.effects if name not in group) + comers
        if names:
            again = EffectTrial(names, best.fit, best.heldout, best.explained, best.loss)
            reason = f"took the place of {gone}"
            search.candidates.insert(
                index, JudgedTrial(item.stage, again, item.gain, search.error, "accepted", reason, ())
            )
        comers = ()


def backward_elimination(search: SearchState, library: Sequence[AbstractEffect], heldout: Heldout) -> None:
    """Accepted effects, and groups of effects with numbers that go together, without which unseen blocks are predicted
    as well are taken out again: the least needed first, until all are needed. Few blocks say little: what the held-out
    error clearly asks for stays."""
    by_name = known_effects(search, library)
    before = list(search.added)
    while len(search.added) > 1:
        without = {}
        for group in _groups(search):
            rest = [by_name[name] for name in search.added if name not in group]
            less = refit_effects(search, rest, -np.inf)
            if block_gain(less, search.current, search.shooting) < _NEEDED:
                less = refit_effects(search, rest)
            needed = np.inf if _pushed(less, search) else block_gain(less, search.current, search.shooting)
            without[group] = less, needed
        group = min(without, key=lambda names: without[names][1])
        less, gain = without[group]
        error = error_with(less.fit, search.shooting, heldout)
        if gain >= SIMPLER or search.error.value < (1.0 - CLEAR_FALL) * error.value:
            break
        search.added = [name for name in search.added if name not in group]
        search.current, search.error = less, error
        withdraw_candidates(search, group)
    if search.added != before:
        _left_over(search, heldout)


def select_smallest_model(search: SearchState, library: Sequence[AbstractEffect], heldout: Heldout) -> None:
    """The smallest model within one standard error of the best over whole runs, blocks where there is one run.

    Accepted effects without which the held-out error stays within _ONE standard error of the best are taken out, the
    least needed first, as long as all that went takes less than CLEAR_FALL off the error together: runs that differ
    make the standard error large, and say nothing about what helps in each of them. So is lateness that may be
    feigned. ``search.without`` holds what is left without each that stays.
    """
    by_name = known_effects(search, library)
    best = search.error.value
    most = min(best + _ONE * search.error.standard_error, best / (1.0 - CLEAR_FALL))
    while len(search.added) > 1:
        search.without = {}
        for name in search.added:
            rest = [by_name[other] for other in search.added if other != name]
            less = refit_effects(search, rest, -np.inf)
            error = error_with(less.fit, search.shooting, heldout)
            if not error.value > _FAR_WORSE * most:
                less = refit_effects(search, rest)
                error = error_with(less.fit, search.shooting, heldout)
            search.without[name] = less, error
        late = [name for name in search.added if _feigned(search, name)]
        can = late or [name for name in search.added if not _pushed(search.without[name][0], search)]
        if not can:
            return
        least = min(can, key=lambda name: search.without[name][1].value)
        if not late and search.without[least][1].value > most and _helps(search.without[least][1], search.error):
            return
        search.added = [other for other in search.added if other != least]
        search.current, search.error = search.without[least]
        withdraw_candidates(search, (least,), "takes less than one standard error off the error over whole runs")
    search.without = {}


def _pushed(less: EffectTrial, search: SearchState) -> bool:
    """Whether what is left without an effect stands at a bound, where the present model does not: another effect's
    number has taken its part over, as far as it may."""
    return bool(search.current.fit.free.all() and not less.fit.free.all())


def _feigned(search: SearchState, name: str) -> bool:
    """Whether an accepted effect, whichever way it came in, is lateness that the rest hardly needs."""
    trial, row = replace(search.current, effects=(name,)), float(np.median(search.shooting.windows.period))
    return is_spurious_delay(trial, search.error, search.without[name][1], row)


def _helps(before: HeldoutError, after: HeldoutError) -> bool:
    """Whether some run, or the mean over all, is predicted better."""
    fell = after.by_run < (1.0 - _ROUNDING) * before.by_run
    return bool(fell.any()) or after.value < (1.0 - _ROUNDING) * before.value


def merge_effects(search: SearchState, library: Sequence[AbstractEffect], heldout: Heldout) -> bool:
    """Two accepted effects give way to one that predicts unseen data as well with as many numbers, and whether two did:
    a payload and a rolling resistance are together exactly a towed load."""
    by_name = known_effects(search, library)
    for pair in combinations(list(search.added), 2):
        rest = [by_name[name] for name in search.added if name not in pair]
        for whole in _wholes(search, pair, by_name):
            best = refit_effects(search, [*rest, whole])
            if _as_good(best, search, heldout):
                _replaced(search, pair, (whole.name,), best, heldout)
                return True
    return False


def _wholes(search: SearchState, pair: Sequence[str], by_name: Mapping[str, AbstractEffect]) -> list[AbstractEffect]:
    """The best rivals of two effects with as many numbers as both together.

    Fewer would be no more than a removal and an exchange, which are tried before.
    """
    numbers = sum(len(by_name[name].parameters) for name in pair)
    names = dict.fromkeys(rival for name in pair for rival in search.rivals.get(name, [])[:_EXCHANGED])
    found = [by_name[name] for name in names if name not in search.added]
    return [item for item in found if len(item.parameters) == numbers]


def _as_good(trial: EffectTrial, search: SearchState, heldout: Heldout) -> bool:
    """Whether a trial within its bounds predicts unseen blocks and held-out rollouts no worse than the model does."""
    if not trial.fit.free.all() or block_gain(trial, search.current, search.shooting) >= SAME:
        return False
    return error_with(trial.fit, search.shooting, heldout).value <= (1.0 + _ROUNDING) * search.error.value


def remove_effects_at_bounds(search: SearchState, library: Sequence[AbstractEffect], heldout: Heldout) -> None:
    """Accepted effects that still stand at a bound of a parameter are taken out: what fits only there is something
    else."""
    by_name = known_effects(search, library)
    bound = effects_at_bounds(search.current)
    group = [name for name in search.added if name in bound]
    if group:
        search.added = [name for name in search.added if name not in group]
        search.current = refit_effects(search, [by_name[name] for name in search.added])
        search.error = error_with(search.current.fit, search.shooting, heldout)
        withdraw_candidates(search, group, "fits only at a bound")


def _left_over(search: SearchState, heldout: Heldout) -> None:
    """What removals leave has to pass by itself: a pair may be confirmed of which one part alone would not be.

    A clear fall of the held-out error does with what a removal would have to lose.
    """
    null = refit_effects(search, [])
    gain = block_gain(null, search.current, search.shooting)
    before = error_with(null.fit, search.shooting, heldout)
    clear = gain > SIMPLER and search.error.value < (1.0 - CLEAR_FALL) * before.value
    if not (clear or passes(gain, search.error, before)):
        withdraw_candidates(search, search.added)
        search.added, search.current, search.error = [], search.first, search.first_error


def _groups(search: SearchState) -> list[tuple[str, ...]]:
    """Each accepted effect by itself, and pairs whose fitted numbers are correlated, but never all of them."""
    singles = [(name,) for name in search.added]
    fitted = search.current.fit
    covariance = regularized_inverse(np.einsum("wip,wiq->pq", fitted.columns, fitted.columns))
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    owner = np.array([path.split(".")[0] for path in fitted.paths])
    found = []
    for one, other in combinations(search.added, 2):
        part = (covariance / np.outer(size, size))[np.ix_(owner == one, owner == other)]
        if len(search.added) > 2 and np.abs(part).max(initial=0.0) > _TOGETHER:
            found.append((one, other))
    return [*singles, *found]


def withdraw_candidates(
    search: SearchState, group: Sequence[str], why: str = "no longer needed next to the others"
) -> None:
    """Candidates that were accepted are said to be gone."""
    for index, item in enumerate(search.candidates):
        gone = set(group) & set(item.trial.effects)
        if item.decision == "accepted" and gone:
            decision = "rejected" if gone == set(item.trial.effects) else "accepted"
            reason = f"{' and '.join(sorted(gone))} {why}"
            search.candidates[index] = with_reason(item, decision, reason)


def exchange_for_fewer_parameters(search: SearchState, library: Sequence[AbstractEffect], heldout: Heldout) -> None:
    """One or two accepted effects give way to as many of their rivals that predict as well with fewer numbers.

    A rival that says the same with a number less was beaten by rounding, or because the others were not there yet: a
    towed load whose resistance is none is a payload.
    """
    by_name = known_effects(search, library)
    while True:
        found = []
        for group in [group for count in (1, 2) for group in combinations(search.added, count)]:
            best = _best_instead(search, group, _with_fewer(search, group, by_name), by_name)
            if best is not None and _as_good(best[0], search, heldout):
                found.append((group, *best))
        if not found:
            return
        group, trial, names = min(found, key=lambda one: one[1].loss)
        _replaced(search, group, names, trial, heldout)


def split_effect(search: SearchState, library: Sequence[AbstractEffect], heldout: Heldout) -> None:
    """An accepted effect gives way to two of its rivals that pass next to the others in its place: a delay of all
    actuators stood for a lag of each. What then stands at a bound made up for the mistake, and goes with it."""
    by_name = known_effects(search, library)
    for name in list(search.added):
        if name not in search.added:
            continue  # went with another
        names = [other for other in search.rivals.get(name, [])[:_EXCHANGED] if other not in search.added]
        best = _best_instead(search, (name,), list(combinations(names, 2)), by_name)
        if best is None:
            continue
        trial, new = best
        idle = [other for other in search.added if other != name and other in effects_at_bounds(trial)]
        if idle:
            retained = [other for other in search.added if other not in (name, *idle)]
            trial = refit_effects(search, [by_name[item] for item in (*retained, *new)])
        gain = block_gain(search.current, trial, search.shooting)
        if trial.fit.free.all() and passes(gain, error_with(trial.fit, search.shooting, heldout), search.error):
            _replaced(search, (name, *idle), new, trial, heldout)


def effects_at_bounds(trial: EffectTrial) -> set[str]:
    """Effects of a trial that stand at a bound of a parameter."""
    return {path.split(".")[0] for path, free in zip(trial.fit.paths, trial.fit.free, strict=True) if not free}


def _with_fewer(
    search: SearchState, group: Sequence[str], by_name: Mapping[str, AbstractEffect]
) -> list[tuple[str, ...]]:
    """As many rivals of some effects, with fewer numbers together."""
    numbers = sum(len(by_name[name].parameters) for name in group)
    rivals = dict.fromkeys(rival for name in group for rival in search.rivals.get(name, [])[:_EXCHANGED])
    names = [name for name in rivals if name not in search.added]
    found = combinations(names, len(group))
    return [one for one in found if sum(len(by_name[name].parameters) for name in one) < numbers]


def _best_instead(
    search: SearchState,
    group: Sequence[str],
    instead: Sequence[tuple[str, ...]],
    by_name: Mapping[str, AbstractEffect],
) -> tuple[EffectTrial, tuple[str, ...]] | None:
    """Which of some effects fits best in the place of others, next to the rest; None where none comes near."""
    rest = [by_name[name] for name in search.added if name not in group]
    enough = search.current.fit.value + _HOPELESS
    tried = [(refit_effects(search, [*rest, *map(by_name.__getitem__, names)], enough), names) for names in instead]
    near = [(trial, names) for trial, names in tried if trial.fit.value <= enough]
    return min(near, key=lambda pair: pair[0].loss, default=None)


def mark_equivalent_rivals(search: SearchState, library: Sequence[AbstractEffect], heldout: Heldout) -> None:
    """Says of each accepted effect which of its rivals predict the same in its place, once all others are known: where
    a payload came later, a command gain may turn out to be a drag as well."""
    by_name = known_effects(search, library)
    for name in search.added if len(search.added) > 1 else ():
        numbers = len(by_name[name].parameters)
        rivals = [other for other in search.rivals.get(name, [])[:_EXCHANGED] if other not in search.added]
        same = []
        for rival in (other for other in rivals if len(by_name[other].parameters) == numbers):
            trial = _best_instead(search, (name,), [(rival,)], by_name)
            if trial is not None and _as_good(trial[0], search, heldout):
                same.append(rival)
        for index, item in enumerate(search.candidates):
            if item.decision == "accepted" and name in item.trial.effects:
                equals = dict.fromkeys((*item.equals, *same))
                search.candidates[index] = replace(item, equals=tuple(equals))
