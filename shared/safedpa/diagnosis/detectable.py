"""Before anything is searched: which effects these very logs could show, from which size on, and which only as a sum.

A parameter moved away from doing nothing displaces the predictions by d (windows, numbers). Were it in the data with s
times that size, the search would see the squares s^2 |d|^2 + 2 s d'e next to the present residual e. Put into the
search's own rule (gain over independent blocks, fall of the rollout error) that gives the smallest s that passes.

Source: Walter and Pronzato, Identification of Parametric Models, Springer 1997, ch. 6 (sensitivities and what an
experiment can tell).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.rollout_error import change_scale
from safedpa.diagnosis.experiment_design.choice import discriminating_manoeuvres
from safedpa.diagnosis.fit.cross_validation import HeldoutError
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, standardized_gain, standardized_gains, with_effect_at
from safedpa.diagnosis.report_schema import Detectable
from safedpa.diagnosis.search.acceptance import CERTAIN, CORNERED, FALL, LIKELY, LITTLE_FALL, SURE, VERY_SURE
from safedpa.effects import AbstractEffect
from safedpa.effects.parameter import Parameter

__all__ = ["detectable_sizes", "with_manoeuvres"]

_TURNED, _MISSED = 20, 1
"""Times that the present residual is turned about, block by block, to see what chance may do to a gain; as many of them
may miss: nineteen of twenty such effects would pass."""
_SUM = 0.985
"""Correlation of what two effects displace from which only their sum can be told."""
_TAKEN = 0.002
"""Share of a displacement that free numbers leave, below which they do the same."""
_CERTAIN = 2.0 * CERTAIN**2
"""Squares in units of the noise from which the filter along whole recordings would be certain; twice what it asks for:
neighbouring residuals depend on each other."""
_SIZES = np.geomspace(1e-3, 1e2, 61)
"""Sizes that are looked at, in ordinary ones."""
_TURNS = 2
"""An effect may be no straight line: its displacement is looked at again where it just shows."""


@dataclass(frozen=True)
class _ParameterSensitivity:
    """What one parameter displaces at ordinary size."""

    item: AbstractEffect
    parameter: Parameter
    ordinary: float
    whole: FloatArray
    """(windows, numbers), the start's part eliminated, in units of the noise."""
    left: FloatArray
    """What free numbers leave of it."""
    ends: FloatArray
    """Root mean square at the windows' ends, in units of each state's change, (states,)."""


def detectable_sizes(
    null: EffectTrial, library: Sequence[AbstractEffect], shooting: Shooting, error: HeldoutError
) -> list[Detectable]:
    """For each effect and each of its numbers the smallest change that the search would have found."""
    known = _known(null)
    found = [moved for item in library for moved in _displaced(null, item, shooting, known)]
    sizes = [_smallest(null, moved, shooting, error, known) for moved in found]
    return [
        Detectable(
            moved.item.name,
            moved.parameter.name,
            moved.parameter.unit,
            None if size is None else size * moved.ordinary,
            moved.ordinary,
            _same(moved, found, null),
        )
        for moved, size in zip(found, sizes, strict=True)
    ]


def with_manoeuvres(
    sizes: Sequence[Detectable], null: EffectTrial, library: Sequence[AbstractEffect]
) -> tuple[Detectable, ...]:
    """The same, and what to drive for those whose ordinary size these logs do not show."""
    by_name = {item.name: item for item in library}
    hidden = [size for size in sizes if not size.shown and size.effect in by_name]
    others = [with_effect_at(null.fit.model, by_name[size.effect], _usual(by_name[size.effect])) for size in hidden]
    drives = discriminating_manoeuvres(null.fit.model, others, np.maximum(null.fit.scale, 1e-9))
    reported = {id(size): drive for size, drive in zip(hidden, drives, strict=True)}
    return tuple(replace(size, drive=reported[id(size)]) if id(size) in reported else size for size in sizes)


def _usual(item: AbstractEffect) -> dict[str, float]:
    """Numbers of an ordinary size."""
    return {p.name: p.typical or 0.1 * p.high for p in item.parameters}


def _known(null: EffectTrial) -> FloatArray:
    """Directions that the free numbers can take, orthonormal (numbers of all windows, some)."""
    columns = null.fit.columns
    if not columns.shape[-1]:
        return np.zeros((null.fit.residual.size, 0))
    left, size, _ = np.linalg.svd(columns.reshape(-1, columns.shape[-1]), full_matrices=False)
    return np.asarray(left[:, size > 1e-9 * max(float(size.max(initial=0.0)), 1e-300)])


def _displaced(
    null: EffectTrial, item: AbstractEffect, shooting: Shooting, known: FloatArray
) -> list[_ParameterSensitivity]:
    """One entry for each parameter of an effect that has a value at which it does nothing."""
    chosen = [p for p in item.parameters if p.neutral is not None]
    values = [_values(item, parameter, 1.0) for parameter in chosen]
    return [] if not chosen else _of(null, item, chosen, values, shooting, known)


def _of(
    null: EffectTrial,
    item: AbstractEffect,
    chosen: Sequence[Parameter],
    values: Sequence[dict[str, float]],
    shooting: Shooting,
    known: FloatArray,
) -> list[_ParameterSensitivity]:
    model = null.fit.model
    now = shooting.residuals([model])[0]
    every = shooting.residuals([with_effect_at(model, item, own) for own in values])
    scale = np.maximum(change_scale(shooting.windows, shooting.windows.end), 1e-9)
    found = []
    for parameter, moved in zip(chosen, every, strict=True):
        change = moved - now
        whole = shooting.eliminated(change[..., None], null.fit.scale)[..., 0]
        flat = whole.reshape(-1)
        left = (flat - known @ (known.T @ flat)).reshape(whole.shape)
        last = np.take_along_axis(change, _last(shooting)[:, None, None], axis=1)[:, 0]
        ends = np.sqrt((last**2).mean(axis=0)) / scale
        found.append(_ParameterSensitivity(item, parameter, _ordinary(parameter), whole, left, ends))
    return found


def _last(shooting: Shooting) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Index of the last compared row inside each window, (windows,)."""
    inside = shooting.windows.steps[:, None] >= shooting.rows
    return np.asarray(inside.shape[1] - 1 - np.argmax(inside[:, ::-1], axis=1), dtype=np.int64)


def _ordinary(parameter: Parameter) -> float:
    neutral = parameter.neutral or 0.0
    change = abs(parameter.typical - neutral)
    return change if change > 0 else 0.1 * (parameter.high - parameter.low)


def _values(item: AbstractEffect, parameter: Parameter, size: float) -> dict[str, float]:
    """The effect with one number moved by ``size`` ordinary changes, the others doing nothing."""
    values = {p.name: p.typical if p.neutral is None else p.neutral for p in item.parameters}
    neutral = parameter.neutral or 0.0
    side = -1.0 if parameter.typical < neutral else 1.0
    values[parameter.name] = float(np.clip(neutral + side * size * _ordinary(parameter), parameter.low, parameter.high))
    return values


def _smallest(
    null: EffectTrial, moved: _ParameterSensitivity, shooting: Shooting, error: HeldoutError, known: FloatArray
) -> float | None:
    """In ordinary sizes; None where no size within bounds would be found."""
    found = _passing(moved, null, shooting, error, 1.0)
    for _ in range(_TURNS):
        if found is None or 0.8 < found < 1.25:
            break
        item, parameter = moved.item, moved.parameter
        again = _of(null, item, [parameter], [_values(item, parameter, found)], shooting, known)[0]
        found = _passing(again, null, shooting, error, found)
    most = (moved.parameter.high - moved.parameter.low) / moved.ordinary
    return found if found is not None and found <= most else None


def _passing(
    moved: _ParameterSensitivity, null: EffectTrial, shooting: Shooting, error: HeldoutError, size: float
) -> float | None:
    """The smallest size of those looked at that would pass, with the displacement of ``size`` taken as a line."""
    if not float((moved.whole**2).sum()) > 0.0 or _taken(moved):
        return None
    squares = shooting.squares(moved.left).sum(axis=1) / size**2
    products = (moved.left * null.fit.residual).sum(axis=1) / size
    ends, before = moved.ends / size, np.nan_to_num(error.per_state, nan=0.0)
    for tried in (float(item) for item in _SIZES):
        after = np.sqrt(before**2 + (tried * ends) ** 2)
        fall = 1.0 - float(before.sum()) / max(float(after.sum()), 1e-300)
        if fall <= LITTLE_FALL:
            continue
        enough = SURE if fall > FALL else VERY_SURE
        if fall > FALL and moved.item.name not in CORNERED and tried**2 * float(squares.sum()) > _CERTAIN:
            enough = LIKELY
        if _sure(tried**2 * squares, 2.0 * tried * products, enough, shooting):
            return tried
    return None


def _sure(squares: FloatArray, products: FloatArray, enough: float, shooting: Shooting) -> bool:
    """Whether the gain passes whatever side the residual of each block is on, nearly always."""
    if standardized_gain(squares, shooting) <= enough:
        return False
    sides = np.random.default_rng(5).choice([-1.0, 1.0], (_TURNED, int(shooting.block.max()) + 1))
    missed = standardized_gains(squares + sides[:, shooting.block] * products, shooting) <= enough
    return int(missed.sum()) <= _MISSED


def _taken(moved: _ParameterSensitivity) -> bool:
    return float((moved.left**2).sum()) < _TAKEN * float((moved.whole**2).sum())


def _same(moved: _ParameterSensitivity, every: Sequence[_ParameterSensitivity], null: EffectTrial) -> tuple[str, ...]:
    """Effects, or the free number, that do the same to the predictions."""
    size = float(np.linalg.norm(moved.whole))
    if not size > 0.0:
        return ()
    if _taken(moved):
        columns = null.fit.columns.reshape(-1, null.fit.columns.shape[-1])
        alike = np.abs(columns.T @ moved.whole.reshape(-1)) / (np.linalg.norm(columns, axis=0) + 1e-30)
        return (null.fit.paths[int(np.argmax(alike))],)
    own = np.linalg.norm(moved.left)
    found = []
    for other in every:
        around = own * np.linalg.norm(other.left)
        if other.item.name == moved.item.name or not around > 0.0 or _taken(other):
            continue
        if abs(float((moved.left * other.left).sum())) / around > _SUM:
            found.append(other.item.name)
    return tuple(dict.fromkeys(found))
