"""Final parameters: windows select the effects, and the filter along whole recordings gives their reported sizes.

The uncertainty allows for a wrong form of the model. A model of the right form has the same parameters in all kinds of
driving, up to chance: slow and fast, straight and in curves, steady and changing. A wrong one does not. Blocks of time
do not reveal that, because each contains every kind of driving. Groups of similar windows do.

Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, ch. 11 (jackknife), over groups of like windows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.comparison.where import POSITION
from safedpa.diagnosis.fit.cross_validation import Heldout, HeldoutError, error_with
from safedpa.diagnosis.fit.least_squares import Fit, bounds_of, fit, jackknife, products_of
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.prediction_error_method import prediction_error_fit
from safedpa.diagnosis.fit.trial import ratio_gain, trial_of
from safedpa.diagnosis.search.acceptance import CLEAR_FALL, CORNERED, FRICTIONS
from safedpa.diagnosis.search.search_state import SearchState
from safedpa.effects import Conditioned, Where

# Relative increase of the held-out error that the filter's values may cause: rollouts from a measured start reward
# parameters that imitate a lasting disturbance.
_MAX_INCREASE = 0.02
# Cap on the difference between filter and windows, in deviations of the windows' value: a larger one means that the
# filter diverged, not that the value is uncertain.
_MAX_DEVIATIONS = 3.0
# Relative shift of a free base parameter beyond which the filter is not used: so much is then missing that its
# disturbances stand for it.
_MAX_SHIFT = 0.5
# Groups of similar windows, of equal size: enough for a spread, few enough that each determines the parameters.
_GROUPS = 8
# Windows in a group: fewer would make the jackknife measure noise.
_MIN_WINDOWS = 3
# Groups exceed the deviation over blocks by this factor by chance once in 5000 (F distribution with 8 groups).
_CHANCE = 2.0


def with_final_values(found: Fit, shooting: Shooting, heldout: Heldout) -> tuple[Fit, HeldoutError]:
    """Returns the fit with the filter's parameters and deviations, if these predict held-out data as well.

    Otherwise, or if the filter moves a free base parameter far, the windows' values stay. The form of the model is then
    wrong in something that the two weight differently. So half of their difference counts as uncertainty, up to three
    deviations by blocks and runs, or 0 where the filter ran to a bound. For effects with a corner, the larger
    of both deviations is used, because the filter linearises there.
    """
    before = error_with(found, shooting, heldout)
    if not found.free.any():
        return found, before
    # Before the filter replaces the values: this uncertainty belongs to the windows' fit.
    found = _with_glitch_uncertainty(found, shooting)
    final = prediction_error_fit(found.model, found.paths, found.free, shooting.windows)
    if final is None:
        return found, before
    stated_before = found.deviations(shooting)
    stated = np.where(np.isfinite(final.deviations), final.deviations, stated_before)
    stated = np.where(_has_corner(found), np.fmax(stated, stated_before), stated)
    moved = replace(found, model=final.model, stated=stated)
    after = error_with(moved, shooting, heldout)
    if after.value <= (1.0 + _MAX_INCREASE) * before.value and not _moved_base_far(found, moved):
        return moved, after
    # A filter that ended at a bound has diverged, so its distance says nothing.
    shift = np.where(_at_bound(moved), 0.0, 0.5 * np.abs(moved.values - found.values))
    return replace(found, stated=np.hypot(stated_before, np.minimum(shift, _MAX_DEVIATIONS * stated_before))), before


def _with_glitch_uncertainty(found: Fit, shooting: Shooting) -> Fit:
    """Adds half of the shift that glitch detection by sampling rate causes to the deviations.

    If recordings have different rates, it is uncertain which rows are glitches.
    """
    other = shooting.with_weights_by_rate(found.model)
    if other is None:
        return found
    again = fit(found.model, found.paths, other, found.scale)
    difference = np.where(found.free & again.free, 0.5 * np.abs(again.values - found.values), 0.0)
    return replace(found, stated=np.hypot(found.deviations(shooting), difference))


def with_model_uncertainty(final: Fit, search: SearchState) -> Fit:
    """Returns the fit with deviations that allow for a wrong form of the model.

    A deviation is at least the spread of the parameter between kinds of driving, if that exceeds chance. Some effects
    are not clearly shown by the held-out error. With the shift d of the parameter without such an effect, the variance
    is std^2 + max over them of (d / 2)^2: the value of either model then lies within two deviations.

    Source: Buckland, Burnham and Augustin, Biometrics 53, 1997 (uncertainty of which model it is).
    """
    now, shift = dict(zip(search.current.fit.paths, search.current.fit.values, strict=True)), np.zeros(len(final.paths))
    for less, error in search.without.values():
        if search.error.value < (1.0 - CLEAR_FALL) * error.value:
            continue
        values = dict(zip(less.fit.paths, less.fit.values, strict=True))
        moved = [abs(values[path] - now[path]) if path in values else 0.0 for path in final.paths]
        shift = np.maximum(shift, moved)
    kinds = group_jackknife_deviation(search.current.fit, search.shooting)
    if not (shift.any() or kinds.any()):
        return final
    return replace(final, stated=np.hypot(np.fmax(final.deviations(search.shooting), kinds), 0.5 * shift))


# Deviations from the neutral value below which an accepted effect is reported as uncertain.
_UNCERTAIN = 2.0


def uncertain_effects(search: SearchState, deviations: float = _UNCERTAIN) -> list[str]:
    """Returns accepted effects with no parameter further than some deviations from its neutral value.

    Effects without a neutral value are never uncertain: there is no zero to compare with.
    """
    fitted, ratios = search.current.fit, dict[str, list[float]]()
    stated = fitted.deviations(search.shooting).tolist()
    for path, value, deviation in zip(fitted.paths, fitted.values.tolist(), stated, strict=True):
        neutral = fitted.model.parameters[path].neutral
        if neutral is not None:
            ratios.setdefault(path.split(".")[0], []).append(abs(value - neutral) / deviation if deviation > 0 else 0.0)
    return [name for name in search.added if max(ratios.get(name, [np.inf])) < deviations]


def with_timing_uncertainty(final: Fit, search: SearchState) -> Fit:
    """Returns the fit with deviations that allow for commands which change between two rows.

    A log has the command that is in force at each row. If it changed a share s of a period before, the mean command
    over the period before the row is (1 - s) u[k] + s u[k + 1], and a fit with s = 0 finds delays that are s periods
    too short. Parameters are fitted for s = 0 and s = 1/2, which is the mean of changes at any time. With the shift d
    of a parameter between the two, the variance is std^2 + w d^2. w is the probability that the timing which the search
    did not take predicts unseen blocks better: the normal distribution of the gain in its standard errors.
    """
    if not final.free.any() or not final.model.system.action:
        return final
    other = search.shooting.with_commands(between_rows=not search.between_rows)
    taken, rival = (fit(final.model, final.paths, windows, final.scale) for windows in (search.shooting, other))
    gain = ratio_gain(trial_of(taken, search.shooting, (), None), trial_of(rival, other, (), None), search.shooting)
    weight = 0.5 * math.erfc(-gain / math.sqrt(2.0))
    shift = np.where(taken.free & rival.free, rival.values - taken.values, 0.0)
    return replace(final, stated=np.hypot(final.deviations(search.shooting), np.sqrt(weight) * np.abs(shift)))


def group_jackknife_deviation(fitted: Fit, shooting: Shooting) -> FloatArray:
    """Returns the largest deviation (paths,) by a jackknife over groups of similar windows; 0 if within chance.

    Windows are sorted by the mean size of each state and action, and by the variation of each action.
    """
    found = np.zeros(len(fitted.paths))
    if not fitted.free.any() or len(shooting.windows) < _GROUPS * _MIN_WINDOWS:
        return found
    products, slopes = products_of(fitted.columns[..., fitted.free], fitted.residual)
    blocks = jackknife(products, slopes, shooting.block)
    largest = np.zeros(len(blocks))
    for kind in _sorting_quantities(shooting):
        rank = np.argsort(np.argsort(kind, kind="stable"), kind="stable")
        largest = np.maximum(largest, jackknife(products, slopes, rank * _GROUPS // len(rank)))
    found[fitted.free] = np.sqrt(np.where(largest > _CHANCE**2 * blocks, largest, 0.0))
    return found


def _sorting_quantities(shooting: Shooting) -> Iterator[FloatArray]:
    """Yields the quantities (windows,) by which windows are sorted, except constant ones."""
    windows = shooting.windows
    rows = np.minimum(windows.start[:, None] + shooting.rows, windows.end[:, None] - 1)
    actions = windows.actions[rows]
    moving = [index for index, variable in enumerate(windows.system.state) if variable.name not in POSITION]
    for values in (
        np.abs(windows.states[rows][..., moving]).mean(axis=1),
        np.abs(actions).mean(axis=1),
        actions.std(axis=1),
    ):
        yield from (column for column in values.T if np.ptp(column) > 0.0)


def _has_corner(found: Fit) -> NDArray[np.bool_]:
    """Returns which parameters belong to dry friction, effects with a corner, or effects with a border, (paths,)."""
    borders = {
        effect.name
        for effect in found.model.effects
        if isinstance(effect, Conditioned) and isinstance(effect.law, Where)
    }
    return np.array([path.split(".")[0] in CORNERED | FRICTIONS | borders for path in found.paths])


def _at_bound(moved: Fit) -> NDArray[np.bool_]:
    """Returns which parameters the filter moved to a bound, (paths,)."""
    low, high = bounds_of(moved.model, moved.paths)
    edge = 1e-6 * (high - low)
    return np.asarray((moved.values <= low + edge) | (moved.values >= high - edge))


def _moved_base_far(before: Fit, after: Fit) -> bool:
    # Only base parameters: an effect's value is expected to move, the base was known roughly before.
    base = np.array([path.startswith("base.") for path in before.paths])
    return bool((np.abs(after.values - before.values)[base] > _MAX_SHIFT * np.abs(before.values)[base]).any())
