"""Effects with a law, in words: what acts where, and how a number varies.

Effects that say where and when they act: tried once the plain ones are found, and kept where they predict more.

An effect of the model gets a law (a condition, or a number that varies), or one of the library comes in with a law,
where unseen blocks and the held-out error say so more clearly than they have to for a plain one: many laws are looked
at. What the law makes superfluous goes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from safedpa.comparison.where import PLACE
from safedpa.diagnosis.fit.cross_validation import Heldout, error_with
from safedpa.diagnosis.fit.least_squares import fit, known_slopes
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
from safedpa.effects.effects_with_law import may_have_law, plain
from safedpa.errors import ModelFileError
from safedpa.operations import NUMPY

__all__ = [
    "add_conditions",
    "add_region_effect",
    "conditions_of",
    "region_effect",
]


def conditions_of(model: PhysicsModel, names: Iterable[str]) -> tuple[Condition, ...]:
    """The laws of the named effects of a model, with a sentence each.

    ``rolling resistance 0.9 m/s2 beyond x = 1.00 m``; ``speed command gain 1.00 at time 0 s, falls by 0.4 % a second``.
    """
    wanted = list(names)
    found = []
    for item in model.effects:
        if item.name in wanted and isinstance(item, Conditioned):
            law = item.law
            assert isinstance(law, (Varies, Where))
            edge = law.edge if isinstance(law, Where) else None
            found.append(Condition(item.name, law.key, law.phrase, edge, _sentence(model, item)))
    return tuple(sorted(found, key=lambda one: wanted.index(one.effect)))


def _sentence(model: PhysicsModel, item: Conditioned) -> str:
    values = {p.name: model.settings[f"{item.name}.{p.name}"].value for p in item.parameters}
    reported = item.law.sentence(values, item.inner, model.system)
    every = item.inner.parameters
    numbers = [_number(p.name if len(every) > 1 else "", values[p.name], p.unit) for p in every]
    name = item.name.replace("_", " ")
    if isinstance(item.law, Varies):
        return f"{name} {', '.join(numbers)} at {item.law.begin(model.system)}, {reported}"
    return f"{name} {', '.join(numbers)} {reported}"


def _number(name: str, value: float, unit: str) -> str:
    return " ".join(part for part in (name, f"{value:.3g}", "" if unit == "1" else unit) if part)


_ENOUGH = ((4.0, FALL), (3.0, 0.3), (2.0, 0.6))
"""Standard errors of gain on unseen blocks with a share of the held-out error: the first are one in 30 000 by chance,
and thousands of laws are looked at. Few blocks lie in one place, so fewer do where so large a share goes."""
_FLOOR = "rolling_resistance"
"""What a place on the floor does."""
_EDGE = 0.05
"""m over which a place on the floor sets in."""
_RARE = 0.04
"""Share of the rows inside a region, or outside, that is the least."""
_THERE = 4.0
"""Of its deviations that a number which adds up has to be away from 0 where its law says nothing."""
_FITTED = 6
"""Laws that are fitted in rollouts in each round."""
_VARIED, _RIVALS = 3, 2
"""Laws that are tried without another effect as well, and on so many rivals of their own."""
_LEFT_OUT, _OF_THOSE, _CANDIDATES = 4, 3, 8
"""Accepted effects without which laws are looked for, laws that are fitted then, and effects that get one."""
_SLIGHT = 5e-4
"""Fall of the objective without which a law is not fitted to the end: one in a thousand of an error."""
_ROUNDS = 3
_THERE_AT_ALL = 0.02
"""Of what a law changes in the run where it changes most: in runs that hardly came to its place chance decides."""
_MOST_RUNS = 0.6
"""Share of the runs that have to be predicted better."""


def add_conditions(search: SearchState, library: Sequence[AbstractEffect], heldout: Heldout) -> bool:
    """Gives laws to effects as long as that predicts unseen data clearly better; whether any got one."""
    for done in range(_ROUNDS):
        best = _lawful(search, library, heldout) or _on_the_floor(search, library, heldout)
        if best is None:  # nothing is left that a law would say
            return done > 0
        _accept(search, _one_sided(best, search), heldout)
        backward_elimination(search, library, heldout)  # what stood for the law
    return True


def _lawful(search: SearchState, library: Sequence[AbstractEffect], heldout: Heldout) -> EffectTrial | None:
    """The best effect with a law, of those that promise most to first order."""
    proposals = screen_conditions(search, library)
    if not proposals:
        return None
    tries = [*_tries(search, proposals, library), *_in_place_of_two(search, library)]
    trials = [trial for proposal, without in tries for trial in _fitted_so_far(search, proposal, without)]
    return _chosen(search, trials, heldout)


def _fitted_so_far(
    search: SearchState, proposal: ConditionalCandidate, without: tuple[str, ...]
) -> Iterator[EffectTrial]:
    """An effect under a law, fitted; and without the accepted effects for which it leaves nothing to do: they stand at
    a bound next to it."""
    trial = _fitted(search, proposal, without)
    if trial is None:
        return
    yield trial
    bound = effects_at_bounds(trial)
    idle = tuple(name for name in search.added if name in bound)
    if idle and proposal.item.name not in bound:
        again = _fitted(search, proposal, (*without, *idle))
        if again is not None:
            yield again


def _on_the_floor(search: SearchState, library: Sequence[AbstractEffect], heldout: Heldout) -> EffectTrial | None:
    """A place where the floor brakes, as the effect that it is, where it would be told as a formula otherwise.

    Few blocks came there, so that laws of all effects cannot be compared there; blocks that did not are counted in.
    """
    if _FLOOR in {item.name for item in search.current.fit.model.effects}:
        return None
    patch = best_region(search.current, search.shooting)
    trial = None if patch is None else region_effect(patch, search, library)
    if trial is None or not _of_some_rows(trial, search):
        return None
    gain = block_gain(search.current, trial, search.shooting)
    fall = 1.0 - error_with(trial.fit, search.shooting, heldout).value / max(search.error.value, 1e-12)
    return trial if any(gain > least and fall > share for least, share in _ENOUGH) else None


def _tries(
    search: SearchState, every: Sequence[ConditionalCandidate], library: Sequence[AbstractEffect]
) -> Iterator[tuple[ConditionalCandidate, tuple[str, ...]]]:
    """The best laws, no more than two of one effect of one kind, and what is left out for each.

    Plain effects together may stand for one law, and one of them for another effect with a law: so the best are tried
    without each of the others too, and on the rivals of their effect.
    """
    found: list[ConditionalCandidate] = []
    for item in every:
        if sum(o.item.name == item.item.name and type(o.law) is type(item.law) for o in found) < 2:
            found.append(item)
        if len(found) == _FITTED:
            break
    by_name = {item.name: item for item in library}
    floor = by_name.get(_FLOOR)
    place = next((own for own in found if set(own.law.variables) <= {*PLACE}), None)
    known = {own.item.name for own in found} | {own.name for own in search.current.fit.model.effects}
    if floor is not None and place is not None and _FLOOR not in known:
        found.append(_begun(search, floor, place.law))  # a place where anything acts is a floor before all else
    for number, proposal in enumerate(found):
        yield proposal, ()
        if number >= _VARIED:
            continue
        name = proposal.item.name
        others = tuple(other for other in search.added if other != name)
        yield from ((proposal, (other,)) for other in others)
        if len(others) > 1:  # three plain effects may stand for one law
            yield proposal, others
        if name in search.added:
            for rival in search.rivals.get(name, [])[:_RIVALS]:
                moved = _on_rival(search, proposal, by_name.get(rival))
                if moved is not None and rival not in search.added:
                    yield moved, (name,)


def _begun(search: SearchState, item: AbstractEffect, law: Where | Varies) -> ConditionalCandidate:
    """An effect under a chosen law, from where it would begin."""
    alone = fit_trial(search.current, [item], search.shooting, steps=1)
    return ConditionalCandidate(
        item, law, initial_law_values(search.current, alone, item, law, search.shooting), 0.0, 0.0
    )


def _in_place_of_two(
    search: SearchState, library: Sequence[AbstractEffect]
) -> Iterator[tuple[ConditionalCandidate, tuple[str, ...]]]:
    """Laws for what is missing without one of the accepted effects, which may stand for nothing but the law; without
    one that has a law as well, which may stand for another law, of the same effect too."""
    known = known_effects(search, library)
    for name in search.added[:_LEFT_OUT]:
        lawful = isinstance(known[name], Conditioned)
        if len(search.added) < 2 and not lawful:
            continue
        less = refit_effects(search, [known[other] for other in search.added if other != name])
        for proposal in screen_conditions(replace(search, current=less), library, _CANDIDATES)[:_OF_THOSE]:
            if lawful or proposal.item.name != name:
                yield proposal, (name,)


def _on_rival(
    search: SearchState, proposal: ConditionalCandidate, rival: AbstractEffect | None
) -> ConditionalCandidate | None:
    """The same law on another effect, from the numbers that this had by itself."""
    if rival is None or not may_have_law(rival, search.shooting.windows.system):
        return None
    own = [item.trial.fit.model for item in search.candidates if item.trial.effects == (rival.name,)]
    varied = next((p.name for p in rival.parameters if p.neutral is not None), None)
    if not own or varied is None:
        return None
    start = {p.name: own[0].settings[f"{rival.name}.{p.name}"].value for p in rival.parameters}
    if isinstance(proposal.law, Varies):
        return ConditionalCandidate(rival, Varies(varied, proposal.law.variable), start, proposal.gain, proposal.fall)
    borders = {name: value for name, value in proposal.start.items() if name not in _names(proposal.item)}
    return ConditionalCandidate(rival, proposal.law, {**borders, **start}, proposal.gain, proposal.fall)


def _names(item: AbstractEffect) -> set[str]:
    return {parameter.name for parameter in item.parameters}


def _with_law(
    model: PhysicsModel,
    item: AbstractEffect,
    law: Where | Varies,
    start: dict[str, float],
    without: Sequence[str] = (),
) -> PhysicsModel:
    """The model with an effect under a law, in the place of the plain one where it has it, and of those ``without``."""
    made = conditioned(item, law, model.system)
    begin = {**{p.name: 0.0 if p.neutral == 0.0 else p.start for p in made.parameters}, **start}
    own = {p.name: Setting(float(np.clip(begin[p.name], p.low, p.high))) for p in made.parameters}
    gone = {item.name, *without}
    rest = [other for other in model.effects if other.name not in gone]
    retained = {path: value for path, value in model.settings.items() if path.split(".")[0] not in gone}
    return PhysicsModel(model.base, rest, retained, model.period).with_effect(made, own)


def _fitted(search: SearchState, proposal: ConditionalCandidate, without: Sequence[str] = ()) -> EffectTrial | None:
    null = search.current
    try:
        model = _with_law(null.fit.model, proposal.item, proposal.law, proposal.start, without)
    except ModelFileError:
        return None
    own = [path for path in model.settings if path.split(".")[0] == proposal.item.name]
    gone = {proposal.item.name, *without}
    rest = [path for path in null.fit.paths if path.split(".")[0] not in gone]
    # not of the effect itself: under a law its numbers bear the same names, and do something else
    known, enough = known_slopes(null.fit, rest), null.fit.value - _SLIGHT
    found = fit(model, [*rest, *own], search.shooting, null.fit.scale, known=known, enough=enough)
    if found.value > enough:
        return None
    return trial_of(found, search.shooting, (proposal.item.name,), null)


def _chosen(search: SearchState, trials: Sequence[EffectTrial], heldout: Heldout) -> EffectTrial | None:
    """The best that passes; of those that cannot be told from it, the one with the fewest numbers."""
    passing = [
        trial
        for trial in trials
        if bool(trial.fit.free.all())
        and _passes(trial, search, heldout)
        and _in_most_runs(trial, search, heldout)
        and _of_some_rows(trial, search)
        and _more_than_its_law(trial, search)
    ]
    if not passing:
        return None
    return _fewest(passing, search)


def _one_sided(best: EffectTrial, search: SearchState) -> EffectTrial:
    """All above the lower border of a range, or below the upper one, where unseen blocks cannot tell it from the range:
    the other border then lies where hardly anybody drove."""
    item = next(own for own in best.fit.model.effects if own.name == best.effects[0])
    if not isinstance(item, Conditioned) or not isinstance(item.law, Where) or item.law.shape != "between":
        return best
    law, own = item.law, {p.name: best.fit.model.settings[f"{item.name}.{p.name}"].value for p in item.parameters}
    gone = {other.name for other in search.current.fit.model.effects} - {other.name for other in best.fit.model.effects}
    plain_one, found = plain(item), [best]
    for shape, end in (("above", "from"), ("below", "to")):
        start = {name: own[name] for name in _names(plain_one)}
        start[f"{law.variable}_{shape}"] = own[f"{law.variable}_{end}"]
        proposal = ConditionalCandidate(plain_one, Where(shape, law.variable, law.edge), start, 0.0, 0.0)
        trial = _fitted(search, proposal, tuple(sorted(gone)))
        if trial is not None and bool(trial.fit.free.all()) and _of_some_rows(trial, search):
            found.append(trial)
    return _fewest(found, search)


def _fewest(trials: Sequence[EffectTrial], search: SearchState) -> EffectTrial:
    """Of the trials that unseen blocks cannot tell from the best one, the one with the fewest numbers."""
    best = min(trials, key=lambda trial: trial.loss)
    close = [trial for trial in trials if block_gain(trial, best, search.shooting) < SIMPLER]
    return min(close or [best], key=lambda trial: (len(trial.fit.paths), trial.loss))


def _passes(trial: EffectTrial, search: SearchState, heldout: Heldout) -> bool:
    """Whether unseen blocks and held-out rollouts are better than with the present model, and with the plain effect."""
    after = error_with(trial.fit, search.shooting, heldout).value
    if not _better(trial, search.current, search.error.value, after, search):
        return False
    own = next(item for item in trial.fit.model.effects if item.name == trial.effects[0])
    if own.name in {item.name for item in search.current.fit.model.effects}:
        return True
    everywhere = fit_trial(search.current, [plain(own)], search.shooting)
    before = error_with(everywhere.fit, search.shooting, heldout).value
    return _better(trial, everywhere, before, after, search)


def _better(trial: EffectTrial, other: EffectTrial, before: float, after: float, search: SearchState) -> bool:
    gain, fall = block_gain(other, trial, search.shooting, local=True), 1.0 - after / max(before, 1e-12)
    return any(gain > least and fall > share for least, share in _ENOUGH)


def _more_than_its_law(trial: EffectTrial, search: SearchState) -> bool:
    """Whether what adds up (a drag, an offset) is there where its law is not: else it is another function than its
    name says, such as a drag that grows with the cube of the speed. A gain is at rest where it is 1."""
    item = next(own for own in trial.fit.model.effects if own.name == trial.effects[0])
    if not isinstance(item, Conditioned) or not isinstance(item.law, Varies):
        return True
    path = f"{item.name}.{item.law.parameter}"
    if trial.fit.model.parameters[path].neutral:
        return True
    at = trial.fit.paths.index(path)
    return bool(abs(trial.fit.values[at]) > _THERE * trial.fit.deviations(search.shooting)[at])


def _of_some_rows(trial: EffectTrial, search: SearchState) -> bool:
    """Whether a region holds some of the rows, and not nearly all."""
    model, windows = trial.fit.model, search.shooting.windows
    item = next(own for own in model.effects if own.name == trial.effects[0])
    if not isinstance(item, Conditioned) or not isinstance(item.law, Where):
        return True
    own = {p.name: model.settings[f"{item.name}.{p.name}"].value for p in item.parameters}
    state = dict(zip(windows.system.state_names, windows.states.T, strict=True))
    action = dict(zip(windows.system.action_names, windows.actions.T, strict=True))
    context = Context(state, action, {}, windows.time, model.period, NUMPY)
    return _RARE < float(np.mean(item.law.inside(own, context))) < 1.0 - _RARE


def _in_most_runs(trial: EffectTrial, search: SearchState, heldout: Heldout) -> bool:
    """Whether most runs are predicted better, by squares of unseen windows or by held-out rollouts without the worst
    twentieth; what changes nothing in a run does not count.

    Without a run a border may move, to first order too far: a few windows are then off by a whole deceleration, and
    rule the squares.
    """
    scale = np.maximum(np.minimum(trial.heldout.sum(axis=0), search.current.heldout.sum(axis=0)), 1e-12)
    better = ((search.current.heldout - trial.heldout) / (scale / search.shooting.size)).sum(axis=1)
    runs = search.shooting.windows.run
    if _most([float(better[runs == run].sum()) for run in np.unique(runs)], 1.0):
        return True
    before, after = search.error.by_run, error_with(trial.fit, search.shooting, heldout).by_run
    return _most((1.0 - after / before)[np.isfinite(after / before)].tolist(), _THERE_AT_ALL)


def _most(sums: Sequence[float], least: float) -> bool:
    """Whether most of what is larger than the least, and than _THERE_AT_ALL of the largest, is above 0."""
    least = max(least, _THERE_AT_ALL * max(map(abs, sums), default=0.0))
    reported = [value for value in sums if abs(value) > least]
    return not reported or sum(value > 0 for value in reported) > _MOST_RUNS * len(reported)


def add_region_effect(search: SearchState, floor: EffectTrial, stage: int, heldout: Heldout) -> bool:
    """Adds a place on the floor, of which a stage found that it explains more than its best effect; always True."""
    _accept(search, floor, heldout, stage)
    return True


def _accept(search: SearchState, best: EffectTrial, heldout: Heldout, stage: int | None = None) -> None:
    gain = block_gain(search.current, best, search.shooting, local=True)
    before = search.error
    search.patch = None
    shooting = search.shooting.around(best.fit.model)
    again = fit(best.fit.model, best.fit.paths, shooting, best.fit.scale)
    name = best.effects[0]
    item = next(own for own in again.model.effects if own.name == name)
    assert isinstance(item, Conditioned)
    search.shooting, search.current = shooting, trial_of(again, shooting, (), None)
    search.error = error_with(again, shooting, heldout)
    if stage is None:
        stage = max((own.stage for own in search.candidates), default=0)
    reason = f"{item.law.key} {item.law.phrase}: gain on unseen blocks {gain:.1f} standard errors over the same model without"
    search.candidates.append(JudgedTrial(stage, best, gain, search.error, "accepted", reason, (), before.value))
    for index, own in enumerate(search.candidates[:-1]):  # the same effect under another law
        paths = [path for path in own.trial.fit.paths if path.split(".")[0] == name]
        if own.decision == "accepted" and not set(paths) <= set(again.paths):
            notice = with_reason(own, "rejected", f"gave way to {name} {item.law.key} {item.law.phrase}")
            search.candidates[index] = notice
    gone = [other for other in search.added if other not in {own.name for own in again.model.effects}]
    if gone:
        search.added = [other for other in search.added if other not in gone]
        withdraw_candidates(search, gone, f"gave way to {name} {item.law.key} {item.law.phrase}")
    if name not in search.added:
        search.added.append(name)


def region_effect(patch: RegionFit, search: SearchState, library: Sequence[AbstractEffect]) -> EffectTrial | None:
    """A place on the floor as rolling resistance that acts there alone; None where it is no such thing.

    A strip of which one border lies where no one drove is all that lies beyond the other: of the shapes that unseen
    blocks cannot tell apart the one with the fewest numbers.
    """
    item = next((own for own in library if own.name == _FLOOR), None)
    if item is None or not patch.values["deceleration"] > 0.0:
        return None
    shooting = search.shooting
    alone = fit_trial(search.current, [item], shooting)
    starts = {Where(patch.place.shape, "", _EDGE): patch.values}
    for variable, shape in product(PLACE, ("above", "below")):
        law = Where(shape, variable, _EDGE)
        starts[law] = initial_law_values(search.current, alone, item, law, shooting)
    every = [_fitted(search, ConditionalCandidate(item, law, start, patch.gain, 0.0)) for law, start in starts.items()]
    found = [trial for trial in every if trial is not None and bool(trial.fit.free.all())]
    return _fewest(found, search) if found else None
