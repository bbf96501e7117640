"""Where, when and how fast a number may differ: thousands of laws compared with unseen windows, to first order.

A law gives each window w of a fit a weight g_w: the share of its rows in a region, or the mean of a variable. The
column c of a number p then has g_w c_w next to it, and the change of unseen squares follows from sums over windows:

    theta = -N^-1 b without the window's fold,   N = sum [C, g c]'[C, g c],   b = sum [C, g c]'r

What is favoured here is fitted and judged in nonlinear rollouts afterwards (``conditions``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.where import PLACE
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, fit_trial, standardized_gain
from safedpa.diagnosis.search.regions import CircularRegion, StripRegion, share_one_area
from safedpa.diagnosis.search.search_state import SearchState, given_effect_names
from safedpa.effects import AbstractEffect, Varies, Where
from safedpa.effects.effects_with_law import may_have_law
from safedpa.effects.law import ABS, TIME, variables_of_law

__all__ = ["ConditionalCandidate", "initial_law_values", "screen_conditions"]

_QUANTILES = np.linspace(0.08, 0.92, 15)
_BETWEEN = np.linspace(0.1, 0.9, 7)
_RARE, _USUAL = 0.04, 0.96
"""Share of the rows in a region: less says little, more is nearly everywhere."""
_EDGE = 0.02
"""Of the range of a variable: the width over which a condition sets in; 0.1 m for places."""
_EDGE_OF_PLACE = 0.05
_SOME = 0.03
"""Share of the rows of either sign without which the size of a variable is the variable."""
_LIKELY = 2.5
"""Standard errors of linearised gain from which a law is fitted."""


@dataclass(frozen=True)
class ConditionalCandidate:
    """An effect with a law, and where its fit begins."""

    item: AbstractEffect
    law: Where | Varies
    start: dict[str, float]
    """Numbers of effect and law by name."""
    gain: float
    """Standard errors, to first order."""
    fall: float
    """Of the squares of unseen windows in units of the noise."""


@dataclass(frozen=True)
class _ParameterColumn:
    """One number of an effect: its column (windows, numbers) about ``now``, and all numbers of the effect there."""

    item: AbstractEffect
    parameter: str
    column: FloatArray
    now: dict[str, float]
    path: int | None = None
    """Its place among the fitted numbers, of an effect that is in the model."""


@dataclass(frozen=True)
class _Weights:
    """Laws of one kind with their weights (laws, windows)."""

    law: Where | Varies | None
    """None: a law of each parameter with the variable."""
    variable: str
    starts: list[dict[str, float]]
    values: FloatArray


def screen_conditions(
    search: SearchState, library: Sequence[AbstractEffect], most: int | None = None
) -> list[ConditionalCandidate]:
    """The best law of each kind for each number, those that predict unseen windows best first.

    Of effects that are not in the model the ``most`` that promise most everywhere, or all: what acts in one place only
    promises little everywhere.
    """
    null, shooting = search.current, search.shooting
    every = list(_weights(shooting))
    sums = _NormalEquations(null, shooting)
    found = []
    for column in _columns(search, library, most):
        for weights in every:
            made = _best(column, weights, sums)
            if made is not None and made.gain > _LIKELY:
                found.append(made)
    return sorted(found, key=lambda item: -item.fall)


def initial_law_values(
    null: EffectTrial, alone: EffectTrial, item: AbstractEffect, law: Where | Varies, shooting: Shooting
) -> dict[str, float]:
    """Where a fit of one effect under a chosen law begins; ``alone`` is its trial everywhere and always alike."""
    column = _of_trial(alone, item, law, null, shooting)
    sums = _NormalEquations(null, shooting)
    if isinstance(law, Varies):
        at = _rows(shooting)
        weights = _Weights(None, law.variable, [{}], _values(law.variable, at, shooting).mean(axis=1)[None])
    else:
        weights = next(
            own
            for own in _weights(shooting, anywhere=True)
            if isinstance(own.law, Where) and (own.law.shape, own.law.variable) == (law.shape, law.variable)
        )
    found = _best(column, weights, sums)
    return column.now if found is None else found.start


def _of_trial(
    trial: EffectTrial, item: AbstractEffect, law: Where | Varies, null: EffectTrial, shooting: Shooting
) -> _ParameterColumn:
    """The column of the number that varies, or of the first that does nothing at some value."""
    named = law.parameter if isinstance(law, Varies) else next(p.name for p in item.parameters if p.neutral is not None)
    index = [p.name for p in item.parameters].index(named) - len(item.parameters)
    scale = np.tile(trial.fit.scale / null.fit.scale, len(shooting.rows))
    now = {p.name: trial.fit.model.settings[f"{item.name}.{p.name}"].value for p in item.parameters}
    return _ParameterColumn(item, named, trial.fit.columns[..., index] * scale, now)


def _columns(search: SearchState, library: Sequence[AbstractEffect], most: int | None) -> Iterator[_ParameterColumn]:
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
                place = fitted.paths.index(path)
                yield _ParameterColumn(item, parameter.name, fitted.columns[..., place], now, place)
    have = {item.name for item in fitted.model.effects}
    by_name = {item.name: item for item in library}
    last = max((item.stage for item in search.candidates), default=0)
    singles = [item.trial for item in search.candidates if item.stage == last and len(item.trial.effects) == 1]
    ratios, last_tried = len(search.shooting.rows), {trial.effects[0] for trial in singles}
    # what was in the model once, and was not tried next to it
    gone = [by_name[name] for name in search.rivals if name in by_name and name not in last_tried | have]
    again = [fit_trial(null, [item], search.shooting, steps=1) for item in gone if may_have_law(item, system)]
    for trial in [*sorted(singles, key=lambda trial: trial.loss)[:most], *again]:
        new = by_name.get(trial.effects[0])
        if new is None or new.name in have or not may_have_law(new, system):
            continue
        scale = np.tile(trial.fit.scale / fitted.scale, ratios)
        now = {p.name: trial.fit.model.settings[f"{new.name}.{p.name}"].value for p in new.parameters}
        for index, parameter in enumerate(new.parameters):
            if parameter.neutral is not None:
                column = trial.fit.columns[..., index - len(new.parameters)] * scale
                yield _ParameterColumn(new, parameter.name, column, now)


def _rows(shooting: Shooting) -> IndexArray:
    """Rows of the table that are compared, (windows, compared)."""
    windows = shooting.windows
    return np.asarray(np.minimum(windows.start[:, None] + shooting.rows, windows.end[:, None]), dtype=np.int64)


def _weights(shooting: Shooting, *, anywhere: bool = False) -> Iterator[_Weights]:
    """Every law of every variable, by the rows of the windows; places in one room, unless ``anywhere``."""
    windows, at = shooting.windows, _rows(shooting)
    room = set(PLACE) <= set(windows.system.state_names) and (anywhere or share_one_area(shooting))
    for name in variables_of_law(windows.system):
        if name in PLACE and not room:
            continue
        values = _values(name, at, shooting)
        low, high = np.quantile(values, [0.02, 0.98])
        least = _EDGE * (high - low)
        if not high - low > 1e-9 or (name.startswith(ABS) and not _both_signs(name, at, shooting, least)):
            continue
        if name not in PLACE:
            yield _Weights(None, name, [{}], values.mean(axis=1)[None])
        yield from _regions(name, values, _EDGE_OF_PLACE if name in PLACE else float(f"{_EDGE * (high - low):.2g}"))
    if room:
        points = np.stack([_values(name, at, shooting) for name in PLACE], axis=-1)
        for place in (CircularRegion(), StripRegion()):
            retained = list(_places(place, points))
            if retained:
                law = Where(place.shape, "", _EDGE_OF_PLACE)
                yield _Weights(law, "", [start for start, _ in retained], np.stack([inside for _, inside in retained]))


def _regions(name: str, values: FloatArray, edge: float) -> Iterator[_Weights]:
    at = np.unique(np.quantile(values, _QUANTILES))
    above = (values[None] > at[:, None, None]).mean(axis=2)
    yield _Weights(Where("above", name, edge), name, [{f"{name}_above": float(each)} for each in at], above)
    yield _Weights(Where("below", name, edge), name, [{f"{name}_below": float(each)} for each in at], 1.0 - above)
    ends = list(combinations(np.unique(np.quantile(values, _BETWEEN)).tolist(), 2))
    inside = [((values > low) & (values < high)).mean(axis=1) for low, high in ends]
    if inside:
        starts = [{f"{name}_from": low, f"{name}_to": high} for low, high in ends]
        yield _Weights(Where("between", name, edge), name, starts, np.stack(inside))


def _places(place: CircularRegion | StripRegion, points: FloatArray) -> Iterator[tuple[dict[str, float], FloatArray]]:
    flat = points.reshape(-1, 2)
    for start, inside in place.starts(flat):
        shares = inside.reshape(points.shape[:2]).mean(axis=1)
        if _RARE < float(shares.mean()) < _USUAL:
            yield start, shares


def _values(name: str, at: IndexArray, shooting: Shooting) -> FloatArray:
    """A variable in every compared row, (windows, compared)."""
    windows, system = shooting.windows, shooting.windows.system
    if name == TIME:
        return np.asarray(windows.time[at])
    own = name.removeprefix(ABS) if name not in (*system.state_names, *system.action_names) else name
    if own in system.state_names:
        found = shooting.measured[..., system.state_names.index(own)]
    else:
        found = windows.actions[at, system.action_names.index(own)]
    return np.asarray(np.abs(found) if own != name else found)


def _both_signs(name: str, at: IndexArray, shooting: Shooting, least: float) -> bool:
    """Whether the size of a variable is another thing than the variable: of both signs by more than ``least``, below
    which noise at rest decides."""
    values = _values(name.removeprefix(ABS), at, shooting)
    return bool((values < -least).mean() > _SOME and (values > least).mean() > _SOME)


class _NormalEquations:
    """Products of residual and columns of a fit, window by window, and what is left of unseen windows without a law.

    A law adds one row and column to the curvature N of all windows. What is not the law's is inverted once for each
    fold that is left out, K = (N without the fold)^-1, and the law's number follows from what K leaves of its own
    curvature (Schur complement).
    """

    def __init__(self, null: EffectTrial, shooting: Shooting) -> None:
        self.shooting, self.residual, self.columns = shooting, null.fit.residual, null.fit.columns
        turned = self.columns.swapaxes(1, 2)
        self.grams, self.slopes = turned @ self.columns, (turned @ self.residual[..., None])[..., 0]
        count = self.columns.shape[-1]
        self.flat = self.grams.reshape(len(self.grams), count * count)
        self.folds = [np.flatnonzero(shooting.fold == fold) for fold in np.unique(shooting.fold)]
        whole, slope = self.grams.sum(axis=0), self.slopes.sum(axis=0)
        ridge = np.diag(_ridge(np.diagonal(whole)))
        rests = [(whole - self.grams[own].sum(axis=0), slope - self.slopes[own].sum(axis=0)) for own in self.folds]
        self.rests = [(np.linalg.inv(gram + ridge), part) for gram, part in rests]
        self.whole = np.linalg.inv(whole + ridge), slope
        self.before = np.zeros(len(self.grams))
        for own, (inverse, part) in zip(self.folds, self.rests, strict=True):
            values = -inverse @ part
            self.before[own] = 2.0 * self.slopes[own] @ values + self.flat[own] @ np.outer(values, values).reshape(-1)

    def judged(self, column: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(laws, windows) fall of unseen squares, (laws, paths + 1) numbers of all windows."""
        alongside = (column[:, None, :] @ self.columns)[:, 0]
        size, slope = (column**2).sum(axis=1), (column * self.residual).sum(axis=1)
        squared = weights**2
        cross, own_size, own_slope = weights @ alongside, squared @ size, weights @ slope
        ridge, left = _ridge(own_size), np.empty(weights.shape)
        for own, rest in zip(self.folds, self.rests, strict=True):
            part, square = weights[:, own], squared[:, own]
            known, last = _solved(
                *rest,
                cross - part @ alongside[own],
                own_size - square @ size[own] + ridge,
                own_slope - part @ slope[own],
            )
            outer = (known[:, :, None] * known[:, None, :]).reshape(len(known), self.flat.shape[1])
            change = 2.0 * known @ self.slopes[own].T + outer @ self.flat[own].T
            mixed = slope[own] + known @ alongside[own].T
            left[:, own] = change + 2.0 * last[:, None] * part * mixed + last[:, None] ** 2 * square * size[own]
        known, last = _solved(*self.whole, cross, own_size + ridge, own_slope)
        return self.before - left, np.concatenate([known, last[:, None]], axis=1)


def _ridge(diagonal: FloatArray) -> FloatArray:
    """Share of curvature that keeps directions without any where they are."""
    return np.asarray(1e-9 * diagonal + 1e-12)


def _solved(
    inverse: FloatArray, slope: FloatArray, cross: FloatArray, size: FloatArray, own: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Numbers (laws, paths) and that of each law (laws,): -N^-1 b with one more row and column for each law.

    ``inverse`` (paths, paths) and ``slope`` (paths,) are without a law, ``cross`` (laws, paths), ``size`` and ``own``
    (laws,) the law's row of N and entry of b.
    """
    turned, without = cross @ inverse, inverse @ slope
    rest = np.maximum(size - (turned * cross).sum(axis=1), 1e-9 * size + 1e-300)
    last = -(own - cross @ without) / rest
    return -without - turned * last[:, None], last


def _best(column: _ParameterColumn, weights: _Weights, sums: _NormalEquations) -> ConditionalCandidate | None:
    """The best law of one kind for one number, by the fall of unseen squares."""
    usual = np.abs(weights.values).mean(axis=1)
    retained = np.flatnonzero((usual > _RARE) & (usual < _USUAL)) if weights.law is not None else np.arange(1)
    parts = np.array_split(retained, -(-len(retained) // 100)) if len(retained) else []
    best: tuple[float, int, FloatArray, FloatArray] | None = None
    for part in parts:
        falls, values = sums.judged(column.column, weights.values[part])
        index = int(falls.sum(axis=1).argmax())
        if best is None or falls[index].sum() > best[0]:
            best = float(falls[index].sum()), int(part[index]), falls[index], values[index]
    if best is None or not best[0] > 0.0:
        return None
    law = weights.law or Varies(column.parameter, weights.variable)
    if isinstance(law, Where) and _inside_out(column, best[3]):
        return None
    start = _start(column, law, weights.starts[best[1]], best[3])
    return ConditionalCandidate(column.item, law, start, standardized_gain(best[2], sums.shooting, local=True), best[0])


def _inside_out(column: _ParameterColumn, values: FloatArray) -> bool:
    """Whether an effect of the model would rather do nothing inside a region than outside: then it acts outside, where
    the region's opposite has it. To first order the two explain the same."""
    if column.path is None:
        return False
    neutral = next(p.neutral for p in column.item.parameters if p.name == column.parameter) or 0.0
    outside = column.now[column.parameter] + float(values[column.path]) - neutral
    return abs(outside) > abs(outside + float(values[-1]))


def _start(
    column: _ParameterColumn, law: Where | Varies, own: dict[str, float], values: FloatArray
) -> dict[str, float]:
    """Numbers of the effect inside a region or at 0 of the variable, and of the law."""
    parameter = next(p for p in column.item.parameters if p.name == column.parameter)
    begin = float(parameter.neutral or 0.0)
    if column.path is not None:
        begin = column.now[column.parameter] + float(values[column.path])
    change = float(values[-1])
    number = begin + (change if isinstance(law, Where) else 0.0)
    found = {**column.now, column.parameter: float(np.clip(number, parameter.low, parameter.high)), **own}
    return {**found, law.rate: change} if isinstance(law, Varies) else found
