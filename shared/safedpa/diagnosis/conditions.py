"""Effects that say where and when they act: tried once the plain ones are found, and kept where they predict more.

An effect of the model gets a law (a condition, or a number that varies), or one of the library comes in with a law,
where unseen blocks and the held-out error say so more clearly than they have to for a plain one: many laws are looked
at. What the law makes superfluous goes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safedpa.diagnosis.condition_screen import Proposal, proposals_of
from safedpa.diagnosis.fitting import fit
from safedpa.diagnosis.found import Judged, Search
from safedpa.diagnosis.heldout import Heldout, error_with
from safedpa.diagnosis.judging import FALL, SIMPLER
from safedpa.diagnosis.patch import Patch
from safedpa.diagnosis.revision import removals
from safedpa.diagnosis.trial import Trial, block_gain, trial_of
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.settings import Setting
from safedpa.effects import AbstractEffect, Conditioned, Context, Varies, Where, conditioned
from safedpa.errors import ModelFileError
from safedpa.operations import NUMPY

__all__ = ["conditional", "of_patch", "placed", "with_law"]

_SURE = 4.0
"""Standard errors of gain on unseen blocks: one in 30 000 by chance, and thousands of laws are looked at."""
_LIKELY, _MUCH = 3.0, 0.3
"""Standard errors that do where so large a share of the held-out error goes: few blocks lie in one place."""
_RARE = 0.04
"""Share of the rows inside a region, or outside, that is the least."""
_FITTED = 6
"""Laws that are fitted in rollouts in each round."""
_ROUNDS = 3
_MOST_RUNS = 0.6
"""Share of the runs that have to be predicted better."""


def conditional(search: Search, library: Sequence[AbstractEffect], heldout: Heldout) -> bool:
    """Gives laws to effects as long as that predicts unseen data clearly better; whether any got one."""
    for done in range(_ROUNDS):
        trials = [
            trial
            for proposal in _to_fit(proposals_of(search, library))
            if (trial := _fitted(search, proposal)) is not None
        ]
        best = _chosen(search, trials, heldout)
        if best is None:
            return done > 0
        _accept(search, best, heldout)
        removals(search, library, heldout)  # what stood for the law
    return True


def _to_fit(every: Sequence[Proposal]) -> list[Proposal]:
    """The best laws, no more than two of one effect's number of one kind."""
    found: list[Proposal] = []
    for item in every:
        same = [other for other in found if other.item is item.item and type(other.law) is type(item.law)]
        if len(same) < 2:
            found.append(item)
        if len(found) == _FITTED:
            break
    return found


def with_law(model: PhysicsModel, item: AbstractEffect, law: Where | Varies, start: dict[str, float]) -> PhysicsModel:
    """The model with an effect under a law, in the place of the plain one where it has it."""
    made = conditioned(item, law, model.system)
    own = {p.name: Setting(float(np.clip(start.get(p.name, p.start), p.low, p.high))) for p in made.parameters}
    rest = [other for other in model.effects if other.name != item.name]
    kept = {path: value for path, value in model.settings.items() if path.split(".")[0] != item.name}
    return PhysicsModel(model.base, rest, kept, model.period).with_effect(made, own)


def _fitted(search: Search, proposal: Proposal) -> Trial | None:
    null = search.current
    try:
        model = with_law(null.fit.model, proposal.item, proposal.law, proposal.start)
    except ModelFileError:
        return None
    own = [path for path in model.settings if path.split(".")[0] == proposal.item.name]
    paths = [*(path for path in null.fit.paths if path.split(".")[0] != proposal.item.name), *own]
    found = fit(model, paths, search.shooting, null.fit.scale)
    return trial_of(found, search.shooting, (proposal.item.name,), null)


def _chosen(search: Search, trials: Sequence[Trial], heldout: Heldout) -> Trial | None:
    """The best that passes; of those that cannot be told from it, the one with the fewest numbers."""
    passing = [
        trial
        for trial in trials
        if bool(trial.fit.free.all())
        and _passes(trial, search, heldout)
        and _in_most_runs(trial, search)
        and _of_some_rows(trial, search)
    ]
    if not passing:
        return None
    best = min(passing, key=lambda trial: trial.loss)
    close = [trial for trial in passing if block_gain(trial, best, search.shooting) < SIMPLER]
    return min(close or [best], key=lambda trial: (len(trial.fit.paths), trial.loss))


def _passes(trial: Trial, search: Search, heldout: Heldout) -> bool:
    gain = block_gain(search.current, trial, search.shooting, local=True)
    if not gain > _LIKELY:
        return False
    fall = 1.0 - error_with(trial.fit, search.shooting, heldout).value / max(search.error.value, 1e-12)
    return (gain > _SURE and fall > FALL) or fall > _MUCH


def _of_some_rows(trial: Trial, search: Search) -> bool:
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


def _in_most_runs(trial: Trial, search: Search) -> bool:
    """Whether most runs are predicted better; what changes nothing in a run does not count."""
    scale = np.maximum(np.minimum(trial.heldout.sum(axis=0), search.current.heldout.sum(axis=0)), 1e-12)
    better = ((search.current.heldout - trial.heldout) / (scale / search.shooting.size)).sum(axis=1)
    runs = search.shooting.windows.run
    sums = [float(better[runs == run].sum()) for run in np.unique(runs)]
    told = [value for value in sums if abs(value) > 1.0]
    return not told or sum(value > 0 for value in told) > _MOST_RUNS * len(told)


def placed(search: Search, floor: Trial, stage: int, heldout: Heldout) -> bool:
    """Adds a place on the floor, of which a stage found that it explains more than its best effect; always True."""
    _accept(search, floor, heldout, stage)
    return True


def _accept(search: Search, best: Trial, heldout: Heldout, stage: int | None = None) -> None:
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
    reason = (
        f"{item.law.key} {item.law.words}: gain on unseen blocks {gain:.1f} standard errors over the same model without"
    )
    search.candidates.append(Judged(stage, best, gain, search.error, "accepted", reason, (), before.value))
    if name not in search.added:
        search.added.append(name)


def of_patch(patch: Patch, search: Search, library: Sequence[AbstractEffect]) -> Trial | None:
    """A place on the floor as rolling resistance that acts there alone; None where it is no such thing."""
    item = next((own for own in library if own.name == "rolling_resistance"), None)
    if item is None or not patch.values["deceleration"] > 0.0:
        return None
    law = Where(patch.place.shape, "", 0.05)
    trial = _fitted(search, Proposal(item, law, patch.values, patch.gain, 0.0))
    return trial if trial is not None and bool(trial.fit.free.all()) else None
