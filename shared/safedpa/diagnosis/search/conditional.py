"""Conditional effects: an effect acts only in a region (a condition), or its parameter varies with a variable.

Both are called laws. They are tried once the plain effects are found. An effect of the model gets a law, or one of the
library enters with a law, if unseen blocks and the held-out error favour it. The thresholds are higher than for plain
effects, because thousands of laws are compared. Effects that the law makes superfluous are removed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from safedpa.comparison.where import POSITION
from safedpa.diagnosis.fit.least_squares import fit, known_slopes, relinearized
from safedpa.diagnosis.fit.multiple_shooting import measurement_noise
from safedpa.diagnosis.fit.trial import EffectTrial, block_gain, fit_trial, trial_of
from safedpa.diagnosis.report_schema import Condition
from safedpa.diagnosis.search.acceptance import FALL, SIMPLER, with_reason
from safedpa.diagnosis.search.backward_revision import (
    backward_elimination,
    effects_at_bounds,
    refit_effects,
    withdraw_candidates,
)
from safedpa.diagnosis.search.conditional_screen import ConditionalCandidate, initial_law_values, screen_conditions
from safedpa.diagnosis.search.regions import RegionFit, best_region
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState, known_effects
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.settings import Setting
from safedpa.effects import AbstractEffect, Conditioned, Context, Varies, Where, conditioned
from safedpa.effects.law import ABS, SHAPES, may_have_law, plain
from safedpa.errors import ModelFileError
from safedpa.operations import NUMPY


def conditions_of(model: PhysicsModel, names: Iterable[str]) -> tuple[Condition, ...]:
    """Returns the laws of the named effects of a model, with a sentence each.

    ``rolling resistance 0.9 m/s2 beyond x = 1.00 m``; ``speed command gain 1.00 at time 0 s, falls by 0.4 % a second``.
    """
    lawful = {item.name: item for item in model.effects if isinstance(item, Conditioned)}
    found = []
    for item in (lawful[name] for name in names if name in lawful):
        edge = item.law.edge if isinstance(item.law, Where) else None
        found.append(Condition(item.name, item.law.key, item.law.phrase, edge, _sentence(model, item)))
    return tuple(found)


def _sentence(model: PhysicsModel, item: Conditioned) -> str:
    values = {p.name: model.settings[f"{item.name}.{p.name}"].value for p in item.parameters}
    law_text = item.law.sentence(values, item.inner, model.system)
    every = item.inner.parameters
    values_text = [_number(p.name if len(every) > 1 else "", values[p.name], p.unit) for p in every]
    name = item.name.replace("_", " ")
    if isinstance(item.law, Varies):
        return f"{name} {', '.join(values_text)} at {item.law.begin(model.system)}, {law_text}"
    return f"{name} {', '.join(values_text)} {law_text}"


def _number(name: str, value: float, unit: str) -> str:
    return " ".join(part for part in (name, f"{value:.3g}", "" if unit == "1" else unit) if part)


# Pairs of (standard errors of gain, reduction of the held-out error), one of which a law needs. Thousands of laws are
# compared and 4 standard errors occur once in 30 000 by chance. Only a few blocks lie in one region, so fewer standard
# errors suffice with a large reduction.
_ENOUGH = ((4.0, FALL), (3.0, 0.3), (2.0, 0.6))
# A region of the floor brakes, so this effect is tried there first.
_FLOOR = "rolling_resistance"
# Width [m] over which a region of the floor sets in: the fit needs a smooth edge, since a step has no derivative.
_EDGE = 0.05
# Smallest share of rows inside a region, and outside: less contains no evidence for its border.
_MIN_ROW_SHARE = 0.04
# Deviations from 0 that an additive parameter needs where its law does not act. Four, because the law was chosen among
# thousands.
_MIN_OFFSET = 4.0
# Laws that are fitted in rollouts in each round. A rollout fit is slow, so only the best of the first-order screen get
# one.
_FITTED_LAWS = 6
# Laws that are also tried without each other effect, and the rivals of their effect that are tried with the same law.
# Each combination needs a fit.
_VARIED, _RIVALS = 3, 2
# Accepted effects without which laws are screened, laws fitted for each, and library effects that may get one. Their
# product bounds the number of fits.
_LEFT_OUT, _LAWS_WITHOUT, _CANDIDATES = 4, 3, 8
# Decrease of the objective (0.05 % of the residual) below which the fit of a law is stopped early, to save time.
_MIN_DECREASE = 5e-4
# Rounds, each adding at most one law. More would only add run time: laws are rare.
_ROUNDS = 3
# Deviations of a state's noise within which a border is not distinguishable from rest.
_AT_REST = 2.0
# A run counts in the vote if the law changes it by this share of the largest change: in runs that hardly enter the
# region chance decides.
_AFFECTED = 0.02
# Share of the affected runs that have to be predicted better: a law that helps fewer describes those runs, not the
# robot.
_MOST_RUNS = 0.6


def add_conditions(search: SearchState) -> bool:
    """Adds laws to effects while they predict unseen data clearly better; returns whether any was added."""
    for done in range(_ROUNDS):
        best = _best_law(search) or _floor_region(search)
        if best is None:
            return done > 0
        accept_law(search, _one_sided(best, search))
        # Plain effects that stood in for the law have become superfluous.
        backward_elimination(search)
    return True


def _best_law(search: SearchState) -> EffectTrial | None:
    """Returns the best effect with a law among those that promise most to first order; None if none passes."""
    proposals = screen_conditions(search)
    if not proposals:
        return None
    tries = [*_law_trials(search, proposals), *_law_trials_without_one(search)]
    trials = [trial for proposal, without in tries for trial in _fit_law_and_prune(search, proposal, without)]
    return _best_passing(search, trials)


def _fit_law_and_prune(
    search: SearchState, proposal: ConditionalCandidate, without: tuple[str, ...]
) -> Iterator[EffectTrial]:
    """Fits an effect under a law, and again without the accepted effects that it pushes to a bound."""
    trial = _fit_law(search, proposal, without)
    if trial is None:
        return
    yield trial
    bound = effects_at_bounds(trial)
    idle = tuple(name for name in search.added if name in bound)
    if idle and proposal.item.name not in bound:
        again = _fit_law(search, proposal, (*without, *idle))
        if again is not None:
            yield again


def _floor_region(search: SearchState) -> EffectTrial | None:
    """Returns rolling resistance inside a region of the floor, if it passes; otherwise a formula would describe it.

    Few blocks lie in such a region, too few to compare laws of all effects there. So the gain is over all blocks.
    """
    # A model can contain an effect once, with one law.
    if _FLOOR in {item.name for item in search.current.fit.model.effects}:
        return None
    region_fit = best_region(search.current, search.shooting)
    trial = None if region_fit is None else region_effect(region_fit, search)
    if trial is None or not _covers_some_rows(trial, search):
        return None
    gain = block_gain(search.current, trial, search.shooting)
    fall = 1.0 - search.error_of(trial.fit).value / max(search.error.value, 1e-12)
    return trial if any(gain > least and fall > share for least, share in _ENOUGH) else None


def _law_trials(
    search: SearchState, every: Sequence[ConditionalCandidate]
) -> Iterator[tuple[ConditionalCandidate, tuple[str, ...]]]:
    """Yields the best laws, at most two per effect and kind, each with the accepted effects to leave out.

    Plain effects together may imitate one law, and one of them may imitate another effect with a law. So the best laws
    are also tried without each of the other effects, and on the rivals of their effect.
    """
    found: list[ConditionalCandidate] = []
    for item in every:
        if sum(o.item.name == item.item.name and type(o.law) is type(item.law) for o in found) < 2:
            found.append(item)
        if len(found) == _FITTED_LAWS:
            break
    by_name = {item.name: item for item in search.library}
    floor = by_name.get(_FLOOR)
    region = next((other for other in found if set(other.law.variables) <= {*POSITION}), None)
    known = {other.item.name for other in found} | {other.name for other in search.current.fit.model.effects}
    if floor is not None and region is not None and _FLOOR not in known:
        # Whatever effect seems to act in a region of the plane, the floor is the likeliest cause.
        found.append(_initial_candidate(search, floor, region.law))
    for number, proposal in enumerate(found):
        yield proposal, ()
        if number >= _VARIED:
            continue
        name = proposal.item.name
        others = tuple(other for other in search.added if other != name)
        yield from ((proposal, (other,)) for other in others)
        if len(others) > 1:  # three plain effects may imitate one law
            yield proposal, others
        if name in search.added:
            for rival in search.rivals.get(name, [])[:_RIVALS]:
                moved = _law_on_rival(search, proposal, by_name.get(rival))
                if moved is not None and rival not in search.added:
                    yield moved, (name,)


def _initial_candidate(search: SearchState, item: AbstractEffect, law: Where | Varies) -> ConditionalCandidate:
    """Returns an effect under a chosen law with the initial values of the screen."""
    alone = fit_trial(search.current, [item], search.shooting, steps=1)
    return ConditionalCandidate(item, law, initial_law_values(search.current, alone, item, law, search.shooting))


def _law_trials_without_one(search: SearchState) -> Iterator[tuple[ConditionalCandidate, tuple[str, ...]]]:
    """Yields laws that explain what is missing without one of the accepted effects, which may only imitate the law.

    An effect that has a law already may imitate another law, also one of the same effect.
    """
    known = known_effects(search)
    for name in search.added[:_LEFT_OUT]:
        lawful = isinstance(known[name], Conditioned)
        if len(search.added) < 2 and not lawful:
            continue
        less = refit_effects(search, [known[other] for other in search.added if other != name])
        for proposal in screen_conditions(replace(search, current=less), _CANDIDATES)[:_LAWS_WITHOUT]:
            if lawful or proposal.item.name != name:
                yield proposal, (name,)


def _law_on_rival(
    search: SearchState, proposal: ConditionalCandidate, rival: AbstractEffect | None
) -> ConditionalCandidate | None:
    """Returns the same law on another effect, starting from the values of that effect's own trial."""
    if rival is None or not may_have_law(rival, search.shooting.windows.system):
        return None
    models = [item.trial.fit.model for item in search.candidates if item.trial.effects == (rival.name,)]
    varied = next((p.name for p in rival.parameters if p.neutral is not None), None)
    if not models or varied is None:
        return None
    start = {p.name: models[0].settings[f"{rival.name}.{p.name}"].value for p in rival.parameters}
    if isinstance(proposal.law, Varies):
        return ConditionalCandidate(rival, Varies(varied, proposal.law.variable), start)
    borders = {name: value for name, value in proposal.start.items() if name not in _names(proposal.item)}
    return ConditionalCandidate(rival, proposal.law, {**borders, **start})


def _names(item: AbstractEffect) -> set[str]:
    return {parameter.name for parameter in item.parameters}


def _with_law(
    model: PhysicsModel,
    item: AbstractEffect,
    law: Where | Varies,
    start: dict[str, float],
    without: Sequence[str] = (),
) -> PhysicsModel:
    """Returns the model with an effect under a law, instead of the plain effect and of those ``without``."""
    lawful = conditioned(item, law, model.system)
    initial = {**{p.name: 0.0 if p.neutral == 0.0 else p.start for p in lawful.parameters}, **start}
    settings = {p.name: Setting(float(np.clip(initial[p.name], p.low, p.high))) for p in lawful.parameters}
    removed = {item.name, *without}
    rest = [other for other in model.effects if other.name not in removed]
    retained = {path: value for path, value in model.settings.items() if path.split(".")[0] not in removed}
    return PhysicsModel(model.base, rest, retained, model.period).with_effect(lawful, settings)


def _fit_law(search: SearchState, proposal: ConditionalCandidate, without: Sequence[str] = ()) -> EffectTrial | None:
    null = search.current
    try:
        model = _with_law(null.fit.model, proposal.item, proposal.law, proposal.start, without)
    except ModelFileError:
        return None
    law_paths = [path for path in model.settings if path.split(".")[0] == proposal.item.name]
    removed = {proposal.item.name, *without}
    rest = [path for path in null.fit.paths if path.split(".")[0] not in removed]
    # Not the slopes of the effect itself: under a law its parameters keep their names but act differently.
    known, enough = known_slopes(null.fit, rest), null.fit.value - _MIN_DECREASE
    found = fit(model, [*rest, *law_paths], search.shooting, null.fit.scale, known=known, enough=enough)
    if found.value > enough:
        return None
    return trial_of(found, search.shooting, (proposal.item.name,), null)


def _best_passing(search: SearchState, trials: Sequence[EffectTrial]) -> EffectTrial | None:
    """Returns the best trial that passes, or its equivalent with the fewest parameters; None if none passes."""
    passing = [
        trial
        for trial in trials
        # A parameter at its bound is implausible: the law then imitates another cause.
        if bool(trial.fit.free.all())
        and _passes(trial, search)
        and _in_most_runs(trial, search)
        and _covers_some_rows(trial, search)
        and not _is_dry_friction(trial, search)
        and _present_outside_law(trial, search)
    ]
    if not passing:
        return None
    return _simplest(passing, search)


def _one_sided(best: EffectTrial, search: SearchState) -> EffectTrial:
    """Replaces a range by a one-sided condition if unseen blocks cannot distinguish the two.

    The other border then lies where the recordings hold hardly any data.
    """
    item = _with_a_law(best)
    if item is None or not isinstance(item.law, Where) or item.law.shape != "between":
        return best
    law, values = item.law, {p.name: best.fit.model.settings[f"{item.name}.{p.name}"].value for p in item.parameters}
    replaced = {other.name for other in search.current.fit.model.effects} - {
        other.name for other in best.fit.model.effects
    }
    plain_one, found = plain(item), [best]
    for shape, end in (("above", "from"), ("below", "to")):
        start = {name: values[name] for name in _names(plain_one)}
        start[f"{law.variable}_{shape}"] = values[f"{law.variable}_{end}"]
        proposal = ConditionalCandidate(plain_one, Where(shape, law.variable, law.edge), start)
        trial = _fit_law(search, proposal, tuple(sorted(replaced)))
        if trial is not None and bool(trial.fit.free.all()) and _covers_some_rows(trial, search):
            found.append(trial)
    return _simplest(found, search)


def _simplest(trials: Sequence[EffectTrial], search: SearchState) -> EffectTrial:
    """Returns the trial with the fewest parameters among those that unseen blocks cannot distinguish from the best."""
    best = min(trials, key=lambda trial: trial.loss)
    close = [trial for trial in trials if block_gain(trial, best, search.shooting) < SIMPLER]
    return min(close or [best], key=lambda trial: (len(trial.fit.paths), trial.loss))


def _with_a_law(trial: EffectTrial) -> Conditioned | None:
    """Returns the effect of a trial; None if it has no law."""
    item = next(effect for effect in trial.fit.model.effects if effect.name == trial.effects[0])
    return item if isinstance(item, Conditioned) else None


def _passes(trial: EffectTrial, search: SearchState) -> bool:
    """Returns whether a trial predicts unseen data better than the current model and than the plain effect."""
    after = search.error_of(trial.fit).value
    if not _better(trial, search.current, search.error.value, after, search):
        return False
    effect = next(item for item in trial.fit.model.effects if item.name == trial.effects[0])
    if effect.name in {item.name for item in search.current.fit.model.effects}:
        return True
    # Otherwise a plain effect that was never tried next to the current model would pass as a law.
    everywhere = fit_trial(search.current, [plain(effect)], search.shooting)
    before = search.error_of(everywhere.fit).value
    return _better(trial, everywhere, before, after, search)


def _better(trial: EffectTrial, other: EffectTrial, before: float, after: float, search: SearchState) -> bool:
    """Returns whether gain and reduction of the error satisfy one of the pairs of _ENOUGH."""
    gain, fall = block_gain(other, trial, search.shooting, local=True), 1.0 - after / max(before, 1e-12)
    return any(gain > least and fall > share for least, share in _ENOUGH)


def _present_outside_law(trial: EffectTrial, search: SearchState) -> bool:
    """Returns whether an additive effect (a drag, an offset) is present where its law has no influence.

    Otherwise the effect is another function than its name says, such as a drag that grows with the cube of the speed.
    Gains are exempt: their neutral value is 1.
    """
    item = _with_a_law(trial)
    if item is None or not isinstance(item.law, Varies):
        return True
    path = f"{item.name}.{item.law.parameter}"
    if trial.fit.model.parameters[path].neutral:
        return True
    at = trial.fit.paths.index(path)
    return bool(abs(trial.fit.values[at]) > _MIN_OFFSET * trial.fit.deviations(search.shooting)[at])


def _covers_some_rows(trial: EffectTrial, search: SearchState) -> bool:
    """Returns whether a region contains some of the rows, but not nearly all."""
    model, windows = trial.fit.model, search.shooting.windows
    item = _with_a_law(trial)
    if item is None or not isinstance(item.law, Where):
        return True
    values = {p.name: model.settings[f"{item.name}.{p.name}"].value for p in item.parameters}
    state = dict(zip(windows.system.state_names, windows.states.T, strict=True))
    action = dict(zip(windows.system.action_names, windows.actions.T, strict=True))
    context = Context(state, action, {}, windows.time, model.period, NUMPY)
    return _MIN_ROW_SHARE < float(np.mean(item.law.inside(values, context))) < 1.0 - _MIN_ROW_SHARE


def _is_dry_friction(trial: EffectTrial, search: SearchState) -> bool:
    """Returns whether a border is at rest, to within the noise: what changes there is dry friction, or its rounding.

    A gain that differs forwards and backwards is none.
    """
    item, windows = _with_a_law(trial), search.shooting.windows
    if item is None or not isinstance(item.law, Where) or item.law.shape not in SHAPES:
        return False
    name, system = item.law.variable.removeprefix(ABS), windows.system
    if name not in system.state_names or name in POSITION:
        return False
    least = _AT_REST * float(np.nan_to_num(measurement_noise(windows))[system.state_names.index(name)])
    settings = trial.fit.model.settings
    own = _names(plain(item))
    borders = [settings[f"{item.name}.{p.name}"].value for p in item.parameters if p.name not in own]
    jumps = name != item.law.variable or all(p.neutral == 0.0 for p in plain(item).parameters)
    return jumps and min(map(abs, borders)) < least


def _in_most_runs(trial: EffectTrial, search: SearchState) -> bool:
    """Returns whether most affected runs are predicted better, by unseen windows or by trimmed held-out rollouts.

    Both are tried because a border may move too far when a run is left out, to first order. A few windows are then off
    by the whole deceleration and dominate the squares; the rollouts are trimmed of the worst 5 %.
    """
    scale = np.maximum(np.minimum(trial.heldout.sum(axis=0), search.current.heldout.sum(axis=0)), 1e-12)
    better = ((search.current.heldout - trial.heldout) / (scale / search.shooting.size)).sum(axis=1)
    runs = search.shooting.windows.run
    if _majority_positive([float(better[runs == run].sum()) for run in np.unique(runs)], 1.0):
        return True
    before, after = search.error.by_run, search.error_of(trial.fit).by_run
    return _majority_positive((1.0 - after / before)[np.isfinite(after / before)].tolist(), _AFFECTED)


def _majority_positive(sums: Sequence[float], least: float) -> bool:
    """Returns whether most sums above ``least``, and above _AFFECTED of the largest one, are positive."""
    least = max(least, _AFFECTED * max(map(abs, sums), default=0.0))
    affected = [value for value in sums if abs(value) > least]
    return not affected or sum(value > 0 for value in affected) > _MOST_RUNS * len(affected)


def accept_law(search: SearchState, best: EffectTrial, stage: int | None = None) -> None:
    """Makes a trial with a law the current model and updates the candidates that it replaces."""
    gain = block_gain(search.current, best, search.shooting, local=True)
    before = search.error
    search.region = None
    again, shooting = relinearized(best.fit, search.shooting)
    name, item = best.effects[0], _with_a_law(best)
    assert item is not None
    search.set_model(again, shooting)
    if stage is None:
        stage = max((other.stage for other in search.candidates), default=0)
    law = f"{item.law.key} {item.law.phrase}"
    reason = f"{law}: gain on unseen blocks {gain:.1f} standard errors over the same model without"
    search.candidates.append(JudgedTrial(stage, best, gain, search.error, "accepted", reason, (), before.value))
    # The report must not list the earlier form of this effect as accepted once the law has replaced it.
    for index, other in enumerate(search.candidates[:-1]):
        paths = [path for path in other.trial.fit.paths if path.split(".")[0] == name]
        if other.decision == "accepted" and not set(paths) <= set(again.paths):
            search.candidates[index] = with_reason(other, "rejected", f"replaced by {name} {law}")
    replaced = [other for other in search.added if other not in {effect.name for effect in again.model.effects}]
    if replaced:
        search.added = [other for other in search.added if other not in replaced]
        withdraw_candidates(search, replaced, f"replaced by {name} {law}")
    if name not in search.added:
        search.added.append(name)


def region_effect(region_fit: RegionFit, search: SearchState) -> EffectTrial | None:
    """Returns a region of the floor as rolling resistance that acts there only; None if it does not brake.

    Half planes are tried as well: a strip with one border outside the driven area is a half plane. Of the shapes that
    unseen blocks cannot distinguish, the one with the fewest parameters is returned.
    """
    item = next((effect for effect in search.available if effect.name == _FLOOR), None)
    if item is None or not region_fit.values["deceleration"] > 0.0:
        return None
    shooting = search.shooting
    alone = fit_trial(search.current, [item], shooting)
    starts = {Where(region_fit.region.shape, "", _EDGE): region_fit.values}
    for variable, shape in product(POSITION, ("above", "below")):
        law = Where(shape, variable, _EDGE)
        starts[law] = initial_law_values(search.current, alone, item, law, shooting)
    every = [_fit_law(search, ConditionalCandidate(item, law, start)) for law, start in starts.items()]
    found = [trial for trial in every if trial is not None and bool(trial.fit.free.all())]
    return _simplest(found, search) if found else None
