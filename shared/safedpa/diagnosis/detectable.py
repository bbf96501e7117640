"""Detectable sizes: which effects given recordings could show, from which size on, and which only as a sum.

A parameter moved away from its neutral value displaces the predictions by d (windows, n). If the data contained s times
that size, the squares would change by s^2 |d|^2 + 2 s d'e, with the present residual e. The acceptance rule of the
search (gain over independent blocks, reduction of the rollout error), applied to that change, gives the smallest s.

Source: Walter and Pronzato, Identification of Parametric Models, Springer 1997, ch. 6 (sensitivities and what an
experiment can tell).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.rollout_error import change_scale
from safedpa.diagnosis.experiment_design import discriminating_manoeuvres
from safedpa.diagnosis.fit.cross_validation import HeldoutError
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, standardized_gain, standardized_gains, with_effect_at
from safedpa.diagnosis.report_schema import Detectable
from safedpa.diagnosis.search.acceptance import CERTAIN, CORNERED, FALL, LIKELY, LITTLE_FALL, SURE, VERY_SURE
from safedpa.effects import AbstractEffect
from safedpa.effects.parameter import Parameter

# Random sign changes of the present residual by block, which show what chance does to a gain, and how many of them may
# fail: an effect of the stated size is found in 95 % of the cases.
_SIGN_CHANGES, _FAILURES = 20, 1
# Correlation of two displacements above which only the sum of the effects can be identified: what separates them is
# then 17 % of either, which the noise hides.
_INDISTINGUISHABLE = 0.985
# Share of a displacement that the free parameters leave, below which they do the same as the effect.
_ABSORBED = 0.002
# Squares, in units of the noise, from which the filter would be certain: twice its threshold, because neighbouring
# residuals are correlated.
_CERTAIN = 2.0 * CERTAIN**2
# Sizes that are tried, relative to the typical one: 12 per factor of ten, so a stated size is exact within 20 %.
_SIZES = np.geomspace(1e-3, 1e2, 61)
# Refinements of the displacement at the size found: effects are nonlinear in their parameters.
_REFINEMENTS = 2


@dataclass(frozen=True)
class _ParameterSensitivity:
    """Displacement of the predictions by one parameter at its typical size."""

    item: AbstractEffect
    parameter: Parameter
    ordinary: float
    whole: FloatArray
    """(windows, n), without what the starts explain, in units of the noise."""
    remaining: FloatArray
    """The part of it that the free parameters cannot absorb."""
    ends: FloatArray
    """Root mean square at the windows' ends, in units of each state's change, (states,)."""


def detectable_sizes(
    null: EffectTrial, library: Sequence[AbstractEffect], shooting: Shooting, error: HeldoutError
) -> list[Detectable]:
    """Returns for each parameter of each effect the smallest change that the search would have found."""
    known = _free_directions(null)
    found = [moved for item in library for moved in _sensitivities(null, item, shooting, known)]
    sizes = [_smallest_size(null, moved, shooting, error, known) for moved in found]
    return [
        Detectable(
            moved.item.name,
            moved.parameter.name,
            moved.parameter.unit,
            None if size is None else size * moved.ordinary,
            moved.ordinary,
            _indistinguishable(moved, found, null),
        )
        for moved, size in zip(found, sizes, strict=True)
    ]


def with_manoeuvres(
    sizes: Sequence[Detectable], null: EffectTrial, library: Sequence[AbstractEffect]
) -> tuple[Detectable, ...]:
    """Adds the manoeuvre that would show them to parameters whose typical size these recordings do not show."""
    by_name = {item.name: item for item in library}
    hidden = [size for size in sizes if not size.shown and size.effect in by_name]
    # An effect whose typical value is 0, such as an angle, is shown at a tenth of its range.
    typical = {name: {p.name: p.typical or 0.1 * p.high for p in item.parameters} for name, item in by_name.items()}
    others = [with_effect_at(null.fit.model, by_name[size.effect], typical[size.effect]) for size in hidden]
    drives = discriminating_manoeuvres(null.fit.model, others, np.maximum(null.fit.scale, 1e-9))
    reported = {id(size): drive for size, drive in zip(hidden, drives, strict=True)}
    return tuple(replace(size, drive=reported[id(size)]) if id(size) in reported else size for size in sizes)


def _free_directions(null: EffectTrial) -> FloatArray:
    """Returns an orthonormal basis of what the free parameters can do to the residual, (n of all windows, rank)."""
    columns = null.fit.columns
    if not columns.shape[-1]:
        return np.zeros((null.fit.residual.size, 0))
    # The SVD drops directions that the free parameters only seem to have because of rounding.
    remaining, size, _ = np.linalg.svd(columns.reshape(-1, columns.shape[-1]), full_matrices=False)
    return np.asarray(remaining[:, size > 1e-9 * max(float(size.max(initial=0.0)), 1e-300)])


def _sensitivities(
    null: EffectTrial, item: AbstractEffect, shooting: Shooting, known: FloatArray
) -> list[_ParameterSensitivity]:
    """Returns the displacement by each parameter of an effect that has a neutral value."""
    chosen = [p for p in item.parameters if p.neutral is not None]
    values = [changed_values(item, parameter, 1.0) for parameter in chosen]
    return [] if not chosen else _sensitivities_at(null, item, chosen, values, shooting, known)


def _sensitivities_at(
    null: EffectTrial,
    item: AbstractEffect,
    chosen: Sequence[Parameter],
    values: Sequence[dict[str, float]],
    shooting: Shooting,
    known: FloatArray,
) -> list[_ParameterSensitivity]:
    model = null.fit.model
    now = shooting.residuals([model])[0]
    every = shooting.residuals([with_effect_at(model, item, parameters) for parameters in values])
    scale = np.maximum(change_scale(shooting.windows, shooting.windows.end), 1e-9)
    inside = shooting.windows.steps[:, None] >= shooting.rows
    last_row = inside.shape[1] - 1 - np.argmax(inside[:, ::-1], axis=1)  # of each window that is compared
    found = []
    for parameter, moved in zip(chosen, every, strict=True):
        change = moved - now
        whole = shooting.eliminated(change[..., None], null.fit.scale)[..., 0]
        flat = whole.reshape(-1)
        remaining = (flat - known @ (known.T @ flat)).reshape(whole.shape)
        last = np.take_along_axis(change, last_row[:, None, None], axis=1)[:, 0]
        ends = np.sqrt((last**2).mean(axis=0)) / scale
        found.append(_ParameterSensitivity(item, parameter, _typical_change(parameter), whole, remaining, ends))
    return found


def _typical_change(parameter: Parameter) -> float:
    neutral = parameter.neutral or 0.0
    change = abs(parameter.typical - neutral)
    return change if change > 0 else 0.1 * (parameter.high - parameter.low)


def changed_values(item: AbstractEffect, parameter: Parameter, size: float) -> dict[str, float]:
    """Returns the effect's parameters with one moved by ``size`` typical changes and the others at neutral."""
    values = {p.name: p.typical if p.neutral is None else p.neutral for p in item.parameters}
    neutral = parameter.neutral or 0.0
    side = -1.0 if parameter.typical < neutral else 1.0
    values[parameter.name] = float(
        np.clip(neutral + side * size * _typical_change(parameter), parameter.low, parameter.high)
    )
    return values


def _smallest_size(
    null: EffectTrial, moved: _ParameterSensitivity, shooting: Shooting, error: HeldoutError, known: FloatArray
) -> float | None:
    """Returns the smallest size found, relative to the typical one; None if no size within bounds would be found."""
    found = _passing(moved, null, shooting, error, 1.0)
    for _ in range(_REFINEMENTS):
        # Close to the size at which the displacement was computed: the line is exact enough there.
        if found is None or 0.8 < found < 1.25:
            break
        item, parameter = moved.item, moved.parameter
        again = _sensitivities_at(null, item, [parameter], [changed_values(item, parameter, found)], shooting, known)[0]
        found = _passing(again, null, shooting, error, found)
    # Extrapolation may leave the bounds of the parameter, where no effect of that size exists.
    most = (moved.parameter.high - moved.parameter.low) / moved.ordinary
    return found if found is not None and found <= most else None


def _passing(
    moved: _ParameterSensitivity, null: EffectTrial, shooting: Shooting, error: HeldoutError, size: float
) -> float | None:
    """Returns the smallest size that would pass, extrapolating linearly from the displacement at ``size``."""
    if not float((moved.whole**2).sum()) > 0.0 or _is_absorbed(moved):
        return None
    squares = shooting.squares(moved.remaining).sum(axis=1) / size**2
    products = (moved.remaining * null.fit.residual).sum(axis=1) / size
    ends, before = moved.ends / size, np.nan_to_num(error.per_state, nan=0.0)
    for tried in (float(item) for item in _SIZES):
        after = np.sqrt(before**2 + (tried * ends) ** 2)
        fall = 1.0 - float(before.sum()) / max(float(after.sum()), 1e-300)
        if fall <= LITTLE_FALL:
            continue
        # The same pairs of thresholds as in acceptance.passes and is_promising.
        enough = SURE if fall > FALL else VERY_SURE
        if fall > FALL and moved.item.name not in CORNERED and tried**2 * float(squares.sum()) > _CERTAIN:
            enough = LIKELY
        if _passes_reliably(tried**2 * squares, 2.0 * tried * products, enough, shooting):
            return tried
    return None


def _passes_reliably(squares: FloatArray, products: FloatArray, enough: float, shooting: Shooting) -> bool:
    """Returns whether the gain passes for nearly all signs of the residual in each block."""
    if standardized_gain(squares, shooting) <= enough:
        return False
    # A fixed seed, so that the same recordings give the same report.
    signs = np.random.default_rng(5).choice([-1.0, 1.0], (_SIGN_CHANGES, int(shooting.block.max()) + 1))
    failures = standardized_gains(squares + signs[:, shooting.block] * products, shooting) <= enough
    return int(failures.sum()) <= _FAILURES


def _is_absorbed(moved: _ParameterSensitivity) -> bool:
    return float((moved.remaining**2).sum()) < _ABSORBED * float((moved.whole**2).sum())


def _indistinguishable(
    moved: _ParameterSensitivity, every: Sequence[_ParameterSensitivity], null: EffectTrial
) -> tuple[str, ...]:
    """Returns the effects, or the free parameter, that displace the predictions in the same way."""
    size = float(np.linalg.norm(moved.whole))
    if not size > 0.0:
        return ()
    if _is_absorbed(moved):
        columns = null.fit.columns.reshape(-1, null.fit.columns.shape[-1])
        alike = np.abs(columns.T @ moved.whole.reshape(-1)) / (np.linalg.norm(columns, axis=0) + 1e-30)
        return (null.fit.paths[int(np.argmax(alike))],)
    norm = np.linalg.norm(moved.remaining)
    found = []
    for other in every:
        around = norm * np.linalg.norm(other.remaining)
        if other.item.name == moved.item.name or not around > 0.0 or _is_absorbed(other):
            continue
        if abs(float((moved.remaining * other.remaining).sum())) / around > _INDISTINGUISHABLE:
            found.append(other.item.name)
    return tuple(dict.fromkeys(found))
