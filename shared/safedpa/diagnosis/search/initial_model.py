"""With which model a search begins: the given one, its own free numbers refitted.

Fits that start far off get stuck, and no one is told: so other starts are tried next to the given one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.naive import naive_errors
from safedpa.diagnosis.fit.cross_validation import Heldout, error_with
from safedpa.diagnosis.fit.least_squares import bounds_of, fit, objectives, typical_change, with_values
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import trial_of
from safedpa.diagnosis.search.search_state import SearchState
from safedpa.dynamics import PhysicsModel

__all__ = ["initial_search"]

_FAR = 0.5
"""Share of a free number."""
_HARDLY = 0.8
"""Of the error of what knows no physics, from which a refitted base may be stuck."""
_STUCK, _SURELY = 0.25, 0.5
"""Share of the held-out error by which another start has to be better, there and elsewhere.

Where much is missing, a free number that stands for all of it is a little better too, and hides what is missing.
"""

_DRAWN = 24
"""Starts next to the given one."""
_TRIED = 2
"""Of them that are fitted."""
_FACTOR = 8.0
"""By which a number may be off to either side."""
_BETTER = 0.02
"""Fall of the objective per independent number from which another start is taken."""
_OFF = 0.5
"""Share of a number by which the given one may be off before weights about it are no good."""
_ROWS = 3
_SEED = 3


def initial_search(model: PhysicsModel, shooting: Shooting, heldout: Heldout) -> SearchState:
    """The search with the given model, its free parameters refitted: from where they stand, unless that gets stuck."""
    given = _begun_at(model, shooting, heldout)
    other = _best_start(model, list(model.latent_names), shooting)
    if other is model:
        return given
    found = _begun_at(other, shooting, heldout)
    lost = given.error.value > _HARDLY * min(naive_errors(heldout.windows).values())
    return found if found.error.value < (1.0 - (_STUCK if lost else _SURELY)) * given.error.value else given


def _begun_at(model: PhysicsModel, shooting: Shooting, heldout: Heldout) -> SearchState:
    free = list(model.latent_names)
    scale = np.maximum(shooting.residuals([model])[0].std(axis=(0, 1)), 1e-6)
    shooting = shooting.around(model)
    begin = fit(model, free, shooting, scale)
    closer = shooting.around(begin.model)
    again = fit(begin.model, free, closer, begin.scale)
    if not _far(begin.values, again.values):
        shooting, begin = closer, again
    first = trial_of(begin, shooting, (), None)
    error = error_with(first.fit, shooting, heldout)
    return SearchState(shooting, first, error, first, error)


def _far(before: FloatArray, after: FloatArray) -> bool:
    """Whether weights again moved a number by more than _FAR: what counts less then is no hand that pushes, but most of
    what the model lacks, and a number fitted to the rest would leave effects nothing to act on."""
    return bool((np.abs(after - before) > _FAR * np.abs(before)).any())


def _best_start(model: PhysicsModel, free: Sequence[str], shooting: Shooting) -> PhysicsModel:
    """The model with the given numbers, or with clearly better ones; ``shooting`` with weights that no model has made.

    Others are fitted to the first part of each window: nearly a regression of measured rates, which is almost linear
    in most numbers. Over whole windows angles go round and starts far off find another valley; and weights about a
    model that is far off count least what would correct it.
    """
    if not free:
        return model
    short = _first_part(shooting)
    scale = np.maximum(short.residuals([model])[0].std(axis=(0, 1)), 1e-6)
    starts = [model, *(with_values(model, dict(zip(free, row, strict=True))) for row in _draws(model, free).tolist())]
    with np.errstate(all="ignore"):
        values = np.nan_to_num(objectives(short.residuals(starts), short, scale), nan=np.inf)
    chosen = [0, *(int(index) for index in np.argsort(values)[:_TRIED] if index)]
    found = [fit(starts[index], free, short, scale).model for index in chosen]
    given = fit(model, free, shooting, scale)
    every = [given, *(fit(near, free, shooting, scale) for near in found)]
    best = min(every, key=lambda item: item.value)
    if best.value < given.value - _BETTER:
        return best.model
    before = np.array([model.settings[path].value for path in free])
    far = (np.abs(given.values - before) > _OFF * np.abs(before)).any()
    return given.model if far else model


def _first_part(shooting: Shooting) -> Shooting:
    """The first fifth of each window, three compared rows at least."""
    count = max(_ROWS, len(shooting.rows) // 5)
    return replace(
        shooting,
        rows=shooting.rows[:count],
        measured=shooting.measured[:, :count],
        counts=shooting.counts[:, :count],
        tangent=shooting.tangent[:, :count],
    )


def _draws(model: PhysicsModel, free: Sequence[str]) -> FloatArray:
    """Starts (starts, numbers): typical values, then factors about what is given, within the bounds."""
    random = np.random.default_rng(_SEED)
    now = np.array([model.settings[path].value for path in free])
    typical = np.array([model.parameters[path].typical for path in free])
    about = np.where(np.abs(now) > 0, now, np.array([typical_change(model.parameters[path]) for path in free]))
    factors = _FACTOR ** random.uniform(-1.0, 1.0, (_DRAWN - 1, len(free)))
    low, high = bounds_of(model, free)
    signs = np.where((low < 0) & (random.random(factors.shape) < 0.5), -1.0, 1.0)
    return np.asarray(np.clip(np.concatenate([typical[None], about * factors * signs]), low, high))
