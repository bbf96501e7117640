"""The numbers that a report states: fitted windows give the effects, whole recordings give their sizes.

A number differs by something between kinds of driving: slow and fast, straight and in curves, steady and changing. A
model of the right form has the same numbers in all of them, but for chance. One that is wrong in form has not, and
stretches of time, each with every kind of driving in it, agree on a wrong number: only kinds of driving show it.

Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, ch. 11 (jackknife), over groups of like windows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.comparison.where import PLACE
from safedpa.diagnosis.fit.cross_validation import Heldout, HeldoutError, error_with
from safedpa.diagnosis.fit.least_squares import Fit, bounds_of, fit, jackknife, products_of
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.prediction_error_method import prediction_error_fit
from safedpa.diagnosis.search.acceptance import CLEAR_FALL, CORNERED, FRICTIONS
from safedpa.diagnosis.search.search_state import SearchState
from safedpa.effects import Conditioned, Where

__all__ = ["group_jackknife_deviation", "with_final_values", "with_model_uncertainty"]

_WORSE = 0.02
"""Share by which the held-out error may grow: rollouts from a measured start reward what a lasting push makes of it."""
_MOST = 3.0
"""Deviations of the windows' number that the difference to the filter counts at most."""
_FAR = 0.5
"""Share of a free number of the base that the filter may move: further off, much is missing, and lasting disturbances
stand for it."""
_GROUPS = 8
"""Of as many windows each."""
_FEWEST = 3
"""Windows in a group."""
_CHANCE = 2.0
"""Times the deviation over blocks that groups give by chance at most: once in 5000 for 8 groups (F distribution)."""


def with_final_values(found: Fit, shooting: Shooting, heldout: Heldout) -> tuple[Fit, HeldoutError]:
    """The fit with the filter's parameters and deviations, where these predict held-out data as well.

    Elsewhere, and where the filter moves a free number of the base far, the windows' numbers stay, and half of what
    both ways differ by counts as uncertain: the model's form is then wrong in something that the two weigh differently.
    Of what has a corner the windows' deviation counts where it is larger: the filter follows a slope there.
    At most three times what blocks and runs say, though, and nothing where the filter ran to a bound: a filter that is
    lost says nothing about a number.
    """
    before = error_with(found, shooting, heldout)
    if not found.free.any():
        return found, before
    found = _counted_otherwise(found, shooting)
    final = prediction_error_fit(found.model, found.paths, found.free, shooting.windows)
    if final is None:
        return found, before
    own = found.deviations(shooting)
    stated = np.where(np.isfinite(final.deviations), final.deviations, own)
    stated = np.where(_cornered(found), np.fmax(stated, own), stated)
    moved = replace(found, model=final.model, stated=stated)
    after = error_with(moved, shooting, heldout)
    if after.value <= (1.0 + _WORSE) * before.value and not _far(found, moved):
        return moved, after
    apart = np.where(_lost(moved), 0.0, 0.5 * np.abs(moved.values - found.values))
    return replace(found, stated=np.hypot(own, np.minimum(apart, _MOST * own))), before


def _counted_otherwise(found: Fit, shooting: Shooting) -> Fit:
    """The fit with half of what its numbers move by where glitches are told rate by rate as further uncertainty: where
    recordings have unlike rates, no one knows which rows are odd."""
    other = shooting.counted_by_rate(found.model)
    if other is None:
        return found
    again = fit(found.model, found.paths, other, found.scale)
    apart = np.where(found.free & again.free, 0.5 * np.abs(again.values - found.values), 0.0)
    return replace(found, stated=np.hypot(found.deviations(shooting), apart))


def with_model_uncertainty(final: Fit, search: SearchState) -> Fit:
    """The fit with deviations that allow for a wrong form of the model.

    At least what the number differs by between kinds of driving, where that is more than chance. And for effects of
    which the held-out error does not clearly show that they act std^2 + max over them of (d / 2)^2, d what the number
    moves by without the effect: then the number of either model lies within two deviations.

    Source: Buckland, Burnham and Augustin, Biometrics 53, 1997 (uncertainty of which model it is).
    """
    now, apart = dict(zip(search.current.fit.paths, search.current.fit.values, strict=True)), np.zeros(len(final.paths))
    for less, error in search.without.values():
        if search.error.value < (1.0 - CLEAR_FALL) * error.value:
            continue
        own = dict(zip(less.fit.paths, less.fit.values, strict=True))
        moved = [abs(own[path] - now[path]) if path in own else 0.0 for path in final.paths]
        apart = np.maximum(apart, moved)
    kinds = group_jackknife_deviation(search.current.fit, search.shooting)
    if not (apart.any() or kinds.any()):
        return final
    return replace(final, stated=np.hypot(np.fmax(final.deviations(search.shooting), kinds), 0.5 * apart))


def group_jackknife_deviation(fitted: Fit, shooting: Shooting) -> FloatArray:
    """The largest standard deviation (paths,) by what each group of like windows moves; 0 where chance would do.

    Windows are put in order by the mean size of each state and action, and by how much each action varies.
    """
    found = np.zeros(len(fitted.paths))
    if not fitted.free.any() or len(shooting.windows) < _GROUPS * _FEWEST:
        return found
    products, slopes = products_of(fitted.columns[..., fitted.free], fitted.residual)
    blocks = jackknife(products, slopes, shooting.block)
    largest = np.zeros(len(blocks))
    for kind in _kinds(shooting):
        place = np.argsort(np.argsort(kind, kind="stable"), kind="stable")
        largest = np.maximum(largest, jackknife(products, slopes, place * _GROUPS // len(place)))
    found[fitted.free] = np.sqrt(np.where(largest > _CHANCE**2 * blocks, largest, 0.0))
    return found


def _kinds(shooting: Shooting) -> Iterator[FloatArray]:
    """What windows are put in order by, (windows,) each; nothing that hardly varies."""
    windows = shooting.windows
    rows = np.minimum(windows.start[:, None] + shooting.rows, windows.end[:, None] - 1)
    actions = windows.actions[rows]
    moving = [index for index, variable in enumerate(windows.system.state) if variable.name not in PLACE]
    for values in (
        np.abs(windows.states[rows][..., moving]).mean(axis=1),
        np.abs(actions).mean(axis=1),
        actions.std(axis=1),
    ):
        yield from (column for column in values.T if np.ptp(column) > 0.0)


def _cornered(found: Fit) -> NDArray[np.bool_]:
    """Numbers of dry friction, of effects with a corner, and of those that begin at a border, (paths,)."""
    borders = {own.name for own in found.model.effects if isinstance(own, Conditioned) and isinstance(own.law, Where)}
    return np.array([path.split(".")[0] in CORNERED | FRICTIONS | borders for path in found.paths])


def _lost(moved: Fit) -> NDArray[np.bool_]:
    """Numbers that the filter put on a bound, (paths,)."""
    low, high = bounds_of(moved.model, moved.paths)
    edge = 1e-6 * (high - low)
    return np.asarray((moved.values <= low + edge) | (moved.values >= high - edge))


def _far(before: Fit, after: Fit) -> bool:
    base = np.array([path.startswith("base.") for path in before.paths])
    return bool((np.abs(after.values - before.values)[base] > _FAR * np.abs(before.values)[base]).any())
