"""Which effects are missing: additions while unseen blocks of time confirm them, exchanges, removals.

Source: the statistics that decide are those of cross-validation over independent blocks (Arlot and Celisse, Statistics
Surveys 4, 2010); forward and backward steps as in Miller, Subset Selection in Regression, 2nd ed., 2002, ch. 3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from safedpa.diagnosis.fitting import fit, objective
from safedpa.diagnosis.heldout import Heldout, HeldoutError, error_with
from safedpa.diagnosis.patch import Patch, best_patch
from safedpa.diagnosis.shooting import Shooting
from safedpa.diagnosis.trial import Trial, block_gain, likeness, starts_of, trial_of, tried, with_start
from safedpa.diagnosis.windows import Floats
from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect

__all__ = ["Judged", "Search", "searched"]

SURE = 3.0
"""Standard errors of gain on unseen blocks that an addition needs, together with FALL."""
VERY_SURE = 4.5
"""Standard errors that do with LITTLE_FALL."""
FALL = 0.03
"""Share by which the held-out rollout error has to fall."""
LITTLE_FALL = 0.004
SAME = 1.0
"""Standard errors within which two candidates cannot be told apart."""
SIMPLER = 2.0
"""Standard errors within which the candidate with fewer parameters is preferred."""
ALIKE = 0.9
"""Correlation of what two candidates explain from which they count as alike, within SIMPLER."""
SAME_SHAPE = 0.985
"""Correlation from which they count as alike within SURE."""
MOST = 8
"""Additions."""
_PAIRS = 5
"""Pairs that are fitted at one stage."""
_EXCHANGED = 4
"""Rivals that each accepted effect is exchanged for."""

Tell = Callable[[int, int], None]


@dataclass(frozen=True)
class Judged:
    """A trial with its verdict."""

    stage: int
    trial: Trial
    gain: float
    """Standard errors on unseen blocks."""
    error: HeldoutError | None
    decision: str
    reason: str
    equals: tuple[str, ...]


@dataclass
class Search:
    """What was found, and everything that was tried on the way."""

    shooting: Shooting
    current: Trial
    error: HeldoutError
    first: Trial
    first_error: HeldoutError
    candidates: list[Judged] = field(default_factory=list)
    added: list[str] = field(default_factory=list)
    patch: Patch | None = None


def searched(
    model: PhysicsModel,
    library: Sequence[AbstractEffect],
    shooting: Shooting,
    heldout: Heldout,
    tell: Tell = lambda _done, _all: None,
) -> Search:
    """Free parameters refitted, then additions until nothing passes."""
    free = list(model.latent_names)
    scale = np.maximum(shooting.residuals([model])[0].std(axis=(0, 1)), 1e-6)
    shooting = shooting.around(model)
    begin = fit(model, free, shooting, scale)
    shooting = shooting.around(begin.model)
    first = trial_of(fit(begin.model, free, shooting, begin.scale), shooting, (), None)
    error = error_with(first.fit, shooting, heldout)
    search = Search(shooting, first, error, first, error)
    seen: dict[str, list[str]] = {}
    for stage in range(MOST if library else 0):
        rest = [item for item in library if item.name not in {own.name for own in search.current.fit.model.effects}]
        trials = []
        for number, item in enumerate(rest):
            trials.append(tried(search.current, [item], search.shooting))
            tell(stage * len(library) + number, (stage + 2) * len(library))
        trials.sort(key=lambda trial: trial.loss)
        if not _addition(search, stage, trials, rest, heldout, seen):
            break
    _exchange(search, library, heldout, seen)
    _removals(search, library, heldout)
    return search


def _addition(
    search: Search,
    stage: int,
    trials: list[Trial],
    rest: list[AbstractEffect],
    heldout: Heldout,
    seen: dict[str, list[str]],
) -> bool:
    """Judges the trials of a stage; adds the best that passes and says whether there was one."""
    null, shooting = search.current, search.shooting
    gains = {trial.effects: block_gain(null, trial, shooting) for trial in trials}
    close = [trial for trial in trials if gains[trial.effects] > 1.0][:6]
    errors = {trial.effects: error_with(trial.fit, shooting, heldout) for trial in close}
    best = _preferred(trials, shooting, null)
    passed = best is not None and _passes(gains[best.effects], errors.get(best.effects), search.error)
    if not passed:  # the one that takes most off the windows may not help over the horizon: then another that does
        good = [t for t in close if _inside(t, null) and _passes(gains[t.effects], errors[t.effects], search.error)]
        best, passed = (good[0], True) if good else (best, False)
    if not passed:
        pairs = _pairs(null, trials, rest, shooting)
        gains |= {trial.effects: block_gain(null, trial, shooting) for trial in pairs}
        errors |= {trial.effects: error_with(trial.fit, shooting, heldout) for trial in pairs}
        good = [t for t in pairs if _inside(t, null) and _passes(gains[t.effects], errors[t.effects], search.error)]
        if good:
            best, passed = min(good, key=lambda trial: trial.loss), True
        trials = sorted([*trials, *pairs], key=lambda trial: trial.loss)
    if passed and best is not None:
        search.patch = _place_instead(null, best, shooting)
        passed = search.patch is None
    for trial in trials:
        search.candidates.append(_judged(search, stage, trial, best, passed, trials, gains, errors))
    if not passed or best is None:
        return False
    for name in best.effects:
        seen[name] = [t.effects[0] for t in trials if len(t.effects) == 1 and t.effects[0] not in best.effects][:12]
    _accept(search, best, errors[best.effects])
    return True


def _accept(search: Search, best: Trial, error: HeldoutError) -> None:
    search.added += [name for name in best.effects if name not in search.added]
    shooting = search.shooting.around(best.fit.model)
    again = fit(best.fit.model, best.fit.paths, shooting, best.fit.scale)
    search.shooting, search.current, search.error = shooting, trial_of(again, shooting, (), None), error


def _passes(gain: float, error: HeldoutError | None, before: HeldoutError) -> bool:
    if error is None or not before.value > 0:
        return False
    fall = 1.0 - error.value / before.value
    return (gain > SURE and fall > FALL) or (gain > VERY_SURE and fall > LITTLE_FALL)


def _preferred(trials: Sequence[Trial], shooting: Shooting, null: Trial) -> Trial | None:
    """The best trial, or the simplest of those that cannot be told from it with certainty."""
    better = [trial for trial in trials if trial.loss < null.loss and _inside(trial, null)]
    if not better:
        return None
    close = [trial for trial in better[:8] if block_gain(trial, better[0], shooting) < SIMPLER]
    close = close or better[:1]
    fewest = min(len(trial.fit.paths) for trial in close)
    return next(trial for trial in close if len(trial.fit.paths) == fewest)


def _inside(trial: Trial, null: Trial) -> bool:
    """Whether none of its own parameters was pushed to a bound: what fits only there is something else."""
    return bool(trial.fit.free[len(null.fit.paths) :].all())


def _equals(trial: Trial, trials: Sequence[Trial], shooting: Shooting, null: Trial) -> tuple[str, ...]:
    """Names of the other trials that unseen blocks cannot tell from this one."""
    found = []
    for other in trials:
        if other is trial or other.loss >= null.loss or set(other.effects) & set(trial.effects):
            continue
        apart = abs(block_gain(other, trial, shooting))
        alike = likeness(other, trial)
        equal = (apart < SAME and alike > 0.5) or (apart < SIMPLER and alike > ALIKE)
        if equal or (apart < SURE and alike > SAME_SHAPE):
            found.append(other.name)
    return tuple(found)


def _judged(
    search: Search,
    stage: int,
    trial: Trial,
    best: Trial | None,
    passed: bool,
    trials: Sequence[Trial],
    gains: dict[tuple[str, ...], float],
    errors: dict[tuple[str, ...], HeldoutError],
) -> Judged:
    gain, error = gains[trial.effects], errors.get(trial.effects)
    shooting, null = search.shooting, search.current
    equals: tuple[str, ...] = ()
    taken = _taken_up(trial, null)
    if gain > 1.5:
        equals = _equals(trial, trials[:10], shooting, null)
    if taken:
        return Judged(stage, trial, gain, error, "rejected", f"the free {taken} does the same", (taken,))
    fall = (
        ""
        if error is None
        else f"; the held-out error changes by {100 * (error.value / search.error.value - 1):+.1f} %"
    )
    sentence = f"gain on unseen blocks {gain:.1f} standard errors{fall}"
    if trial is best and passed:
        return Judged(stage, trial, gain, error, "accepted", sentence, equals)
    if trial is best and search.patch is not None:
        return Judged(stage, trial, gain, error, "suspected", f"{sentence}; but a place explains more", equals)
    if passed and best is not None:
        behind = block_gain(trial, best, shooting)
        other = best.name
        reason = f"{sentence}; {behind:.1f} standard errors behind {other}"
        suspected = best.name in equals or (gain > SURE and behind < SIMPLER)
        return Judged(stage, trial, gain, error, "suspected" if suspected else "rejected", reason, equals)
    if gain > SURE:
        return Judged(stage, trial, gain, error, "suspected", f"{sentence}: too little to be worth it", equals)
    return Judged(stage, trial, gain, error, "rejected", sentence, equals)


def _taken_up(trial: Trial, null: Trial) -> str:
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


def _pairs(null: Trial, trials: Sequence[Trial], rest: Sequence[AbstractEffect], shooting: Shooting) -> list[Trial]:
    """The pairs that promise most to first order, fitted."""
    columns, owners = _displacements(null, rest, shooting)
    order = _promising(null, columns, owners)
    singles = {trial.effects[0]: trial for trial in trials}
    found = []
    for one, other in order[:_PAIRS]:
        trial = tried(null, [rest[one], rest[other]], shooting)
        if trial.loss < min(singles[rest[one].name].loss, singles[rest[other].name].loss):
            found.append(trial)
    return found


def _displacements(null: Trial, rest: Sequence[AbstractEffect], shooting: Shooting) -> tuple[Floats, list[int]]:
    """What each effect at each of its starts changes in the residual: columns (numbers, all starts), and owners."""
    columns, owners = [], []
    for index, item in enumerate(rest):
        models = [with_start(null.fit.model, item, values) for values in starts_of(item)]
        residuals = shooting.residuals([null.fit.model]) if not models else shooting.residuals(models)
        stacked = np.moveaxis(residuals, 0, -1)
        reduced = shooting.eliminated(stacked, null.fit.scale).reshape(-1, len(models))
        columns.append(reduced - null.fit.residual.reshape(-1, 1))
        owners += [index] * len(models)
    return np.concatenate(columns, axis=1).astype(np.float32), owners


def _promising(null: Trial, columns: Any, owners: list[int]) -> list[tuple[int, int]]:
    """Pairs of effects, the one whose best two columns take most squares off the residual first."""
    target: Any = np.asarray(null.fit.residual.reshape(-1), dtype=np.float32)
    if null.fit.columns.shape[-1]:
        known, _ = np.linalg.qr(null.fit.columns.reshape(len(target), -1).astype(np.float32))
        columns, target = columns - known @ (known.T @ columns), target - known @ (known.T @ target)
    columns = columns / (np.linalg.norm(columns, axis=0) + 1e-6)
    slope, gram = -(columns.T @ target), columns.T @ columns
    share = np.maximum(1.0 - gram**2, 1e-3)
    both = (slope[:, None] ** 2 + slope[None] ** 2 - 2 * gram * slope[:, None] * slope[None]) / share
    owner = np.array(owners)
    gains: dict[tuple[int, int], float] = {}
    for one, other in combinations(range(int(owner.max()) + 1), 2):
        part = both[np.ix_(owner == one, owner == other)]
        gains[one, other] = float(part.max())
    return sorted(gains, key=lambda pair: -gains[pair])


def _place_instead(null: Trial, best: Trial, shooting: Shooting) -> Patch | None:
    """A patch of the plane that explains the residual better than the effect, and goes on explaining beside it."""
    patch = best_patch(null, shooting)
    if patch is None or not patch.beats(best, shooting):
        return None
    return patch


def _refit(search: Search, items: Sequence[AbstractEffect]) -> Trial:
    """The given effects on top of the first model, from the numbers that the present model has, or from starts."""
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
        starts = [with_start(made, item, values) for made in starts for values in starts_of(item)]
    residual = search.shooting.residuals(starts)
    values = [objective(part, search.shooting, search.current.fit.scale)[0] for part in residual]
    paths = [*search.first.fit.paths, *(f"{item.name}.{p.name}" for item in items for p in item.parameters)]
    found = fit(starts[int(np.argmin(values))], paths, search.shooting, search.current.fit.scale)
    return trial_of(found, search.shooting, (), None)


def _exchange(search: Search, library: Sequence[AbstractEffect], heldout: Heldout, seen: dict[str, list[str]]) -> None:
    """Each accepted effect gives way to a rival that predicts unseen blocks better beside the others."""
    by_name = {item.name: item for item in library}
    if len(search.added) < 2:
        return
    for name in list(search.added):
        others = [by_name[other] for other in search.added if other != name]
        rivals = [by_name[other] for other in seen.get(name, []) if other not in search.added][:_EXCHANGED]
        best = min((_refit(search, [*others, rival]) for rival in rivals), key=lambda t: t.loss, default=None)
        if best is None or best.loss >= search.current.loss:
            continue
        if block_gain(search.current, best, search.shooting) > SIMPLER:
            new = next(i.name for i in best.fit.model.effects if i.name not in {*search.added, *_given(search)})
            _replace(search, name, new, best, heldout)


def _given(search: Search) -> set[str]:
    return {item.name for item in search.first.fit.model.effects}


def _replace(search: Search, name: str, new: str, best: Trial, heldout: Heldout) -> None:
    search.added[search.added.index(name)] = new
    search.current = best
    search.error = error_with(best.fit, search.shooting, heldout)
    gone = [item for item in search.candidates if item.decision == "accepted" and name in item.trial.effects]
    for item in gone:
        index = search.candidates.index(item)
        search.candidates[index] = _with(item, "rejected", f"gave way to {new} once the others were known")
        again = Trial((new,), best.fit, best.heldout, best.explained, best.loss)
        search.candidates.insert(
            index, Judged(item.stage, again, item.gain, search.error, "accepted", f"took the place of {name}", ())
        )


def _with(item: Judged, decision: str, reason: str) -> Judged:
    return Judged(item.stage, item.trial, item.gain, item.error, decision, f"{item.reason}; {reason}", item.equals)


def _removals(search: Search, library: Sequence[AbstractEffect], heldout: Heldout) -> None:
    """Accepted effects without which unseen blocks are predicted as well are taken out again."""
    by_name = {item.name: item for item in library}
    for name in list(search.added):
        if len(search.added) < 2:
            return
        others = [by_name[other] for other in search.added if other != name]
        less = _refit(search, others)
        if block_gain(less, search.current, search.shooting) < SIMPLER:
            search.added.remove(name)
            search.current, search.error = less, error_with(less.fit, search.shooting, heldout)
            for index, item in enumerate(search.candidates):
                if item.decision == "accepted" and item.trial.effects == (name,):
                    search.candidates[index] = _with(item, "rejected", "no longer needed beside the others")
