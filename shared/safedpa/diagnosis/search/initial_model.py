"""The initial model of a search: the given one with its free parameters refitted.

A fit from a poor start ends in a local minimum without a warning. So other starts are tried alongside the given one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.rollout_error import naive_errors
from safedpa.diagnosis.fit.cross_validation import Heldout, error_with
from safedpa.diagnosis.fit.least_squares import bounds_of, fit, objectives, relinearized, typical_change, with_values
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import trial_of
from safedpa.diagnosis.search.acceptance import MOST_MISSING
from safedpa.diagnosis.search.search_state import SearchState
from safedpa.dynamics import PhysicsModel

# Relative change of a free parameter from which updated weights are rejected.
_MAX_SHIFT = 0.5
# A refitted model with more than this share of the error of a naive prediction may be in a local minimum.
_NAIVE_SHARE = 0.8
# Reduction of the held-out error that another start needs, in that case and otherwise. A parameter that makes up for
# many missing effects fits a little better too, and would hide them.
_REDUCTION_IF_STUCK, _REDUCTION = 0.25, 0.5
# Random starts besides the given one; simulating them costs little compared with one fit.
_DRAWN_STARTS = 24
# Starts that are fitted: a fit is far more expensive than the objective at a start.
_FITTED_STARTS = 2
# Starts lie up to this factor above or below the given value: a wrong unit or gear ratio is rarely further off.
_FACTOR = 8.0
# Decrease of the objective per degree of freedom from which another start is taken: 2 % of the residual.
_MIN_DECREASE = 0.02
# Relative error of a given value from which weights computed with it are useless.
_BAD_GUESS = 0.5
# Fixed, so that a diagnosis of the same recordings gives the same report.
_SEED = 3


def initial_search(model: PhysicsModel, shooting: Shooting, heldout: Heldout) -> SearchState:
    """Returns the search with the given model, its free parameters refitted from the given values or a better start."""
    search = _search_from(model, shooting, heldout)
    other = _best_start(model, list(model.latent_names), shooting)
    if other is not model:
        found = _search_from(other, shooting, heldout)
        stuck = search.error.value > _NAIVE_SHARE * min(naive_errors(heldout.windows).values())
        reduction = _REDUCTION_IF_STUCK if stuck else _REDUCTION
        search = found if found.error.value < (1.0 - reduction) * search.error.value else search
    return replace(search, given=model, raw=shooting, first_shooting=search.shooting)


def base_bound_message(search: SearchState) -> str:
    """Returns which free parameters of the base ended at a bound before any effect was added; empty if none did."""
    fitted = search.first.fit
    low, high = bounds_of(fitted.model, fitted.paths)
    edge = 1e-6 * (high - low)
    ends = (fitted.values <= low + edge) | (fitted.values >= high - edge)
    names = [
        f"{path} = {value:.3g} {fitted.model.parameters[path].unit}"
        for path, value, end in zip(fitted.paths, fitted.values.tolist(), ends.tolist(), strict=True)
        if end
    ]
    if not names:
        return ""
    return (
        f"{', '.join(names)} ended at a bound before any effect was added: the model lacks something large, or its "
        "bounds, or the units of the recordings, are wrong"
    )


def base_error_message(search: SearchState) -> str:
    """Returns that the refitted base predicts worse than a naive prediction, or little at all; empty if it does not."""
    naive, error = naive_errors(search.heldout.windows), search.first_error.value
    name = min(naive, key=lambda one: naive[one])
    if error > naive[name] > 0.0:
        return f"its error is {error:.3g}, compared with {naive[name]:.3g} of predicting {name.replace('_', ' ')}"
    if not error <= MOST_MISSING:
        return f"its error is {error:.3g} of the usual change"
    return ""


def _search_from(model: PhysicsModel, shooting: Shooting, heldout: Heldout) -> SearchState:
    """Fits the free parameters from the model's values and returns the search that starts there."""
    free = list(model.latent_names)
    scale = np.maximum(shooting.residuals([model])[0].std(axis=(0, 1)), 1e-6)
    shooting = shooting.around(model)
    fitted = fit(model, free, shooting, scale)
    # The weights are updated once around the fit, unless that moves a parameter far.
    again, closer = relinearized(fitted, shooting)
    if not _moved_far(fitted.values, again.values):
        fitted, shooting = again, closer
    first = trial_of(fitted, shooting, (), None)
    error = error_with(first.fit, shooting, heldout)
    return SearchState(shooting, first, error, first, error, heldout)


def _moved_far(before: FloatArray, after: FloatArray) -> bool:
    """Returns whether updated weights moved a parameter by more than _MAX_SHIFT.

    Then the down-weighted windows are not disturbances but show most of what the model lacks. A parameter fitted to the
    rest would leave missing effects nothing to explain.
    """
    return bool((np.abs(after - before) > _MAX_SHIFT * np.abs(before)).any())


def _best_start(model: PhysicsModel, free: Sequence[str], shooting: Shooting) -> PhysicsModel:
    """Returns the model with the given values, or with clearly better ones; ``shooting`` has uniform weights.

    Other starts are fitted to the first part of each window. That is nearly a regression of measured rates, which is
    almost linear in most parameters. Over whole windows, angles wrap and distant starts find another local minimum.
    A model that is far off would also down-weight the windows that correct it.
    """
    if not free:
        return model
    short = shooting.first_part()
    scale = np.maximum(short.residuals([model])[0].std(axis=(0, 1)), 1e-6)
    drawn = _random_starts(model, free).tolist()
    starts = [model, *(with_values(model, dict(zip(free, row, strict=True))) for row in drawn)]
    with np.errstate(all="ignore"):
        values = np.nan_to_num(objectives(short.residuals(starts), short, scale), nan=np.inf)
    chosen = [0, *(int(index) for index in np.argsort(values)[:_FITTED_STARTS] if index)]
    found = [fit(starts[index], free, short, scale).model for index in chosen]
    given = fit(model, free, shooting, scale)
    every = [given, *(fit(near, free, shooting, scale) for near in found)]
    best = min(every, key=lambda item: item.value)
    if best.value < given.value - _MIN_DECREASE:
        return best.model
    before = np.array([model.settings[path].value for path in free])
    far = (np.abs(given.values - before) > _BAD_GUESS * np.abs(before)).any()
    return given.model if far else model


def _random_starts(model: PhysicsModel, free: Sequence[str]) -> FloatArray:
    """Returns starts (starts, paths): typical values, then random factors of the given ones, within the bounds."""
    random = np.random.default_rng(_SEED)
    now = np.array([model.settings[path].value for path in free])
    typical = np.array([model.parameters[path].typical for path in free])
    about = np.where(np.abs(now) > 0, now, np.array([typical_change(model.parameters[path]) for path in free]))
    # Log-uniform: half and double are equally likely.
    factors = _FACTOR ** random.uniform(-1.0, 1.0, (_DRAWN_STARTS - 1, len(free)))
    low, high = bounds_of(model, free)
    signs = np.where((low < 0) & (random.random(factors.shape) < 0.5), -1.0, 1.0)
    return np.asarray(np.clip(np.concatenate([typical[None], about * factors * signs]), low, high))
