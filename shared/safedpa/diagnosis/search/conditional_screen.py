"""Screens thousands of laws to first order: where, when and with which variable a parameter may differ.

A law gives each window w of a fit a weight g_w: the share of its rows in a region, or the mean of a variable. The
column c of a parameter then gets a companion g_w c_w. The change of the squares of unseen windows follows from sums
over windows:

    theta = -N^-1 b without the window's fold,   N = sum [C, g c]'[C, g c],   b = sum [C, g c]'r

The best laws are fitted and judged in nonlinear rollouts afterwards (``conditional``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.where import POSITION
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, fit_trial, standardized_gain
from safedpa.diagnosis.search.regions import CircularRegion, StripRegion, share_one_area
from safedpa.diagnosis.search.search_state import SearchState, given_effect_names
from safedpa.effects import AbstractEffect, Varies, Where
from safedpa.effects.law import ABS, TIME, may_have_law, variables_of_law

# Quantiles of a variable at which a one-sided condition may begin: equal shares of the data, so that every candidate
# has rows on both sides. A fit moves the border afterwards.
_QUANTILES = np.linspace(0.08, 0.92, 15)
# Fewer for ranges, since all pairs of them are tried.
_RANGE_QUANTILES = np.linspace(0.1, 0.9, 7)
# Share of the rows in a region: a smaller one is too little evidence, a larger one acts nearly everywhere.
_MIN_SHARE, _MAX_SHARE = 0.04, 0.96
# Width over which a condition sets in, as a share of the variable's range, and in m for positions: narrow enough to be
# a border, wide enough to have a derivative.
_EDGE = 0.02
_POSITION_EDGE = 0.05
# Share of the rows that each sign needs for |variable| to differ from the variable.
_BOTH_SIGNS = 0.03
# Standard errors of linearised gain from which a law is fitted: lower than the final threshold, because the first order
# underestimates the gain of laws that change much.
_LIKELY = 2.5


@dataclass(frozen=True)
class ConditionalCandidate:
    """An effect with a law, and the initial values of its fit."""

    item: AbstractEffect
    law: Where | Varies
    start: dict[str, float]
    """Parameters of effect and law by name."""
    gain: float = 0.0
    """Gain on unseen blocks in standard errors, to first order."""
    fall: float = 0.0
    """Reduction of the squares of unseen windows, in units of the noise."""


@dataclass(frozen=True)
class _ParameterColumn:
    """One parameter of an effect: its derivative (windows, n) at ``now``, the values of all the effect's parameters."""

    item: AbstractEffect
    parameter: str
    column: FloatArray
    now: dict[str, float]
    path: int | None = None
    """Its index among the fitted parameters; None for an effect that is not in the model."""


@dataclass(frozen=True)
class _Weights:
    """Laws of one kind with their weights (laws, windows)."""

    law: Where | Varies | None
    """None: the parameter varies with the variable."""
    variable: str
    starts: list[dict[str, float]]
    values: FloatArray


def screen_conditions(search: SearchState, most: int | None = None) -> list[ConditionalCandidate]:
    """Returns the best law of each kind for each parameter, those that predict unseen windows best first.

    Of effects that are not in the model, the ``most`` with the lowest loss without a law are screened. None screens all
    of them: an effect that acts in one region promises little everywhere.
    """
    null, shooting = search.current, search.shooting
    every = list(_weights(shooting))
    sums = _NormalEquations(null, shooting)
    found = []
    for column in _columns(search, most):
        for weights in every:
            candidate = _best_law(column, weights, sums)
            if candidate is not None and candidate.gain > _LIKELY:
                found.append(candidate)
    return sorted(found, key=lambda item: -item.fall)


def initial_law_values(
    null: EffectTrial, alone: EffectTrial, item: AbstractEffect, law: Where | Varies, shooting: Shooting
) -> dict[str, float]:
    """Returns the initial values for a fit of one effect under a chosen law; ``alone`` is its trial without a law."""
    columns = {column.parameter: column for column in _columns_of_trial(alone, item, null, shooting)}
    # The parameter that varies, or the first one with a neutral value.
    column = columns[law.parameter if isinstance(law, Varies) else next(iter(columns))]
    sums = _NormalEquations(null, shooting)
    if isinstance(law, Varies):
        at = _rows(shooting)
        weights = _Weights(None, law.variable, [{}], _values(law.variable, at, shooting).mean(axis=1)[None])
    else:
        kind = law.shape, law.variable
        every = ((one, one.law) for one in _weights(shooting, anywhere=True))
        weights = next(one for one, own in every if isinstance(own, Where) and (own.shape, own.variable) == kind)
    found = _best_law(column, weights, sums)
    return column.now if found is None else found.start


def _columns_of_trial(
    trial: EffectTrial, item: AbstractEffect, null: EffectTrial, shooting: Shooting
) -> Iterator[_ParameterColumn]:
    """Yields the columns of the parameters of one effect on trial, in units of the null's noise."""
    scale = np.tile(trial.fit.scale / null.fit.scale, len(shooting.rows))
    now = {p.name: trial.fit.model.settings[f"{item.name}.{p.name}"].value for p in item.parameters}
    for index, parameter in enumerate(item.parameters):
        if parameter.neutral is not None:
            column = trial.fit.columns[..., index - len(item.parameters)] * scale
            yield _ParameterColumn(item, parameter.name, column, now)


def _columns(search: SearchState, most: int | None) -> Iterator[_ParameterColumn]:
    null, system = search.current, search.shooting.windows.system
    fitted = null.fit
    given = given_effect_names(search)
    for item in fitted.model.effects:
        if item.name in given or not may_have_law(item, system):
            continue
        now = {p.name: fitted.model.settings[f"{item.name}.{p.name}"].value for p in item.parameters}
        for parameter in item.parameters:
            path = f"{item.name}.{parameter.name}"
            if path in fitted.paths and parameter.neutral is not None:
                index = fitted.paths.index(path)
                yield _ParameterColumn(item, parameter.name, fitted.columns[..., index], now, index)
    have = {item.name for item in fitted.model.effects}
    by_name = {item.name: item for item in search.library}
    last = max((item.stage for item in search.candidates), default=0)
    singles = [item.trial for item in search.candidates if item.stage == last and len(item.trial.effects) == 1]
    last_tried = {trial.effects[0] for trial in singles}
    # Effects that were removed from the model have no trial on top of the current one: one rough step gives a column.
    removed = [by_name[name] for name in search.rivals if name in by_name and name not in last_tried | have]
    again = [fit_trial(null, [item], search.shooting, steps=1) for item in removed if may_have_law(item, system)]
    for trial in [*sorted(singles, key=lambda trial: trial.loss)[:most], *again]:
        new = by_name.get(trial.effects[0])
        if new is not None and new.name not in have and may_have_law(new, system):
            yield from _columns_of_trial(trial, new, null, search.shooting)


def _rows(shooting: Shooting) -> IndexArray:
    """Returns the rows of the table that are compared, (windows, compared)."""
    windows = shooting.windows
    return np.asarray(np.minimum(windows.start[:, None] + shooting.rows, windows.end[:, None]), dtype=np.int64)


def _weights(shooting: Shooting, *, anywhere: bool = False) -> Iterator[_Weights]:
    """Yields every law of every variable; laws of the position only if the runs share one area, or ``anywhere``."""
    windows, at = shooting.windows, _rows(shooting)
    room = set(POSITION) <= set(windows.system.state_names) and (anywhere or share_one_area(shooting))
    for name in variables_of_law(windows.system):
        if name in POSITION and not room:
            continue
        values = _values(name, at, shooting)
        low, high = np.quantile(values, [0.02, 0.98])
        least = _EDGE * (high - low)
        # |variable| duplicates the variable unless both signs occur.
        if not high - low > 1e-9 or (name.startswith(ABS) and not _both_signs(name, at, shooting, least)):
            continue
        # No parameter varies linearly with the position: floors differ by region.
        if name not in POSITION:
            yield _Weights(None, name, [{}], values.mean(axis=1)[None])
        edge = _POSITION_EDGE if name in POSITION else float(f"{_EDGE * (high - low):.2g}")
        yield from _intervals(name, values, edge)
    if room:
        points = np.stack([_values(name, at, shooting) for name in POSITION], axis=-1)
        for region in (CircularRegion(), StripRegion()):
            retained = list(_region_starts(region, points))
            if retained:
                law = Where(region.shape, "", _POSITION_EDGE)
                yield _Weights(law, "", [start for start, _ in retained], np.stack([inside for _, inside in retained]))


def _intervals(name: str, values: FloatArray, edge: float) -> Iterator[_Weights]:
    """Yields conditions above, below and between quantiles of a variable."""
    at = np.unique(np.quantile(values, _QUANTILES))
    above = (values[None] > at[:, None, None]).mean(axis=2)
    yield _Weights(Where("above", name, edge), name, [{f"{name}_above": float(each)} for each in at], above)
    yield _Weights(Where("below", name, edge), name, [{f"{name}_below": float(each)} for each in at], 1.0 - above)
    ends = list(combinations(np.unique(np.quantile(values, _RANGE_QUANTILES)).tolist(), 2))
    inside = [((values > low) & (values < high)).mean(axis=1) for low, high in ends]
    if inside:
        starts = [{f"{name}_from": low, f"{name}_to": high} for low, high in ends]
        yield _Weights(Where("between", name, edge), name, starts, np.stack(inside))


def _region_starts(
    region: CircularRegion | StripRegion, points: FloatArray
) -> Iterator[tuple[dict[str, float], FloatArray]]:
    """Yields regions of the plane that contain neither too few nor nearly all rows, with each window's share inside."""
    flat = points.reshape(-1, 2)
    for start, inside in region.starts(flat):
        shares = inside.reshape(points.shape[:2]).mean(axis=1)
        if _MIN_SHARE < float(shares.mean()) < _MAX_SHARE:
            yield start, shares


def _values(name: str, at: IndexArray, shooting: Shooting) -> FloatArray:
    """Returns a variable in every compared row, (windows, compared)."""
    windows, system = shooting.windows, shooting.windows.system
    if name == TIME:
        return np.asarray(windows.time[at])
    base_name = name.removeprefix(ABS) if name not in (*system.state_names, *system.action_names) else name
    if base_name in system.state_names:
        found = shooting.measured[..., system.state_names.index(base_name)]
    else:
        found = windows.actions[at, system.action_names.index(base_name)]
    return np.asarray(np.abs(found) if base_name != name else found)


def _both_signs(name: str, at: IndexArray, shooting: Shooting, least: float) -> bool:
    """Returns whether a variable has both signs by more than ``least``; below that noise at rest decides the sign."""
    values = _values(name.removeprefix(ABS), at, shooting)
    return bool((values < -least).mean() > _BOTH_SIGNS and (values > least).mean() > _BOTH_SIGNS)


class _NormalEquations:
    """Products of residual and columns of a fit by window, and the squares of unseen windows without a law.

    A law adds one row and column to the curvature N. The part without the law is inverted once per left-out fold,
    K = (N without the fold)^-1. The law's parameter then follows from the Schur complement of its row, so thousands of
    laws need no further inversion.
    """

    def __init__(self, null: EffectTrial, shooting: Shooting) -> None:
        self.shooting, self.residual, self.columns = shooting, null.fit.residual, null.fit.columns
        transposed = self.columns.swapaxes(1, 2)
        self.grams, self.slopes = transposed @ self.columns, (transposed @ self.residual[..., None])[..., 0]
        count = self.columns.shape[-1]
        self.flat = self.grams.reshape(len(self.grams), count * count)
        self.folds = [np.flatnonzero(shooting.fold == fold) for fold in np.unique(shooting.fold)]
        whole, slope = self.grams.sum(axis=0), self.slopes.sum(axis=0)
        ridge = np.diag(_ridge(np.diagonal(whole)))
        without_fold = [
            (whole - self.grams[fold].sum(axis=0), slope - self.slopes[fold].sum(axis=0)) for fold in self.folds
        ]
        self.without_fold = [(np.linalg.inv(gram + ridge), part) for gram, part in without_fold]
        self.whole = np.linalg.inv(whole + ridge), slope
        # Unseen squares without a law, to first order: the reference of every law.
        self.before = np.zeros(len(self.grams))
        for fold, (inverse, part) in zip(self.folds, self.without_fold, strict=True):
            values = -inverse @ part
            self.before[fold] = 2.0 * self.slopes[fold] @ values + self.flat[fold] @ np.outer(values, values).reshape(
                -1
            )

    def reductions(self, column: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the reduction of unseen squares (laws, windows) and the parameters for all data (laws, paths + 1)."""
        alongside = (column[:, None, :] @ self.columns)[:, 0]
        size, slope = (column**2).sum(axis=1), (column * self.residual).sum(axis=1)
        squared = weights**2
        cross, own_size, own_slope = weights @ alongside, squared @ size, weights @ slope
        ridge, remaining = _ridge(own_size), np.empty(weights.shape)
        for fold, inverse_and_slope in zip(self.folds, self.without_fold, strict=True):
            part, square = weights[:, fold], squared[:, fold]
            known, last = _solve_bordered(
                *inverse_and_slope,
                cross - part @ alongside[fold],
                own_size - square @ size[fold] + ridge,
                own_slope - part @ slope[fold],
            )
            outer = (known[:, :, None] * known[:, None, :]).reshape(len(known), self.flat.shape[1])
            change = 2.0 * known @ self.slopes[fold].T + outer @ self.flat[fold].T
            mixed = slope[fold] + known @ alongside[fold].T
            remaining[:, fold] = change + 2.0 * last[:, None] * part * mixed + last[:, None] ** 2 * square * size[fold]
        known, last = _solve_bordered(*self.whole, cross, own_size + ridge, own_slope)
        return self.before - remaining, np.concatenate([known, last[:, None]], axis=1)


def _ridge(diagonal: FloatArray) -> FloatArray:
    """Returns a ridge that keeps directions without curvature at 0."""
    return np.asarray(1e-9 * diagonal + 1e-12)


def _solve_bordered(
    inverse: FloatArray, slope: FloatArray, cross: FloatArray, size: FloatArray, law_slope: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns the parameters (laws, paths) and that of each law (laws,): -N^-1 b with one more row and column per law.

    ``inverse`` (paths, paths) and ``slope`` (paths,) are without a law. ``cross`` (laws, paths) and ``size`` (laws,)
    are the law's row of N, ``own`` (laws,) its entry of b.
    """
    cross_inverse, without = cross @ inverse, inverse @ slope
    schur = np.maximum(size - (cross_inverse * cross).sum(axis=1), 1e-9 * size + 1e-300)
    last = -(law_slope - cross @ without) / schur
    return -without - cross_inverse * last[:, None], last


def _best_law(column: _ParameterColumn, weights: _Weights, sums: _NormalEquations) -> ConditionalCandidate | None:
    """Returns the best law of one kind for one parameter by the reduction of unseen squares; None if none helps."""
    share = np.abs(weights.values).mean(axis=1)
    retained = np.flatnonzero((share > _MIN_SHARE) & (share < _MAX_SHARE)) if weights.law is not None else np.arange(1)
    # Chunks of a hundred laws bound the memory of the products below.
    parts = np.array_split(retained, -(-len(retained) // 100)) if len(retained) else []
    best: tuple[float, int, FloatArray, FloatArray] | None = None
    for part in parts:
        falls, values = sums.reductions(column.column, weights.values[part])
        index = int(falls.sum(axis=1).argmax())
        if best is None or falls[index].sum() > best[0]:
            best = float(falls[index].sum()), int(part[index]), falls[index], values[index]
    if best is None or not best[0] > 0.0:
        return None
    law = weights.law or Varies(column.parameter, weights.variable)
    if isinstance(law, Where) and _better_outside(column, best[3]):
        return None
    start = _initial_values(column, law, weights.starts[best[1]], best[3])
    return ConditionalCandidate(column.item, law, start, standardized_gain(best[2], sums.shooting, local=True), best[0])


def _better_outside(column: _ParameterColumn, values: FloatArray) -> bool:
    """Returns whether an effect of the model would be closer to neutral inside the region than outside.

    Then the complement of the region is the right law. To first order the two explain the same.
    """
    # For a new effect the question does not arise: it is neutral outside the region.
    if column.path is None:
        return False
    neutral = next(p.neutral for p in column.item.parameters if p.name == column.parameter) or 0.0
    outside = column.now[column.parameter] + float(values[column.path]) - neutral
    return abs(outside) > abs(outside + float(values[-1]))


def _initial_values(
    column: _ParameterColumn, law: Where | Varies, law_values: dict[str, float], values: FloatArray
) -> dict[str, float]:
    """Returns initial values of the effect (inside a region, or at 0 of the variable) and of the law."""
    parameter = next(p for p in column.item.parameters if p.name == column.parameter)
    value = float(parameter.neutral or 0.0)
    if column.path is not None:
        value = column.now[column.parameter] + float(values[column.path])
    change = float(values[-1])
    number = value + (change if isinstance(law, Where) else 0.0)
    # The linear estimate may leave the bounds, where a fit could not start.
    found = {**column.now, column.parameter: float(np.clip(number, parameter.low, parameter.high)), **law_values}
    return {**found, law.rate: change} if isinstance(law, Varies) else found
