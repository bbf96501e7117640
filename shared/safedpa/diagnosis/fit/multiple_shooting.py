"""Short rollouts with a start of their own, all windows of all runs and all variants of a model side by side.

The measured start of a window is noisy. So its entries are unknowns as well: to first order they are eliminated from
the residuals window by window (multiple shooting, variable projection). What is left depends on the model alone.

Source: Bock and Plitt, A multiple shooting algorithm, IFAC 1984; Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.windows import Windows, windows_of
from safedpa.diagnosis.fit.simulation import simulate
from safedpa.diagnosis.fit.variable_projection import VariableProjection
from safedpa.dynamics import PhysicsModel
from safedpa.records.run import Run

__all__ = ["Shooting", "block_seconds", "folds_of", "shooting_of"]

_ROWS = 24
"""Rows of a window that are compared at most."""
_STEP = 1e-4
"""Difference of a start's entry, in its unit."""
_BLOCKS = 40
"""Independent stretches of time that are wanted, of at least and at most so many seconds each:"""
_BLOCK = (3.0, 10.0)
_FEWEST_BLOCKS = 10
"""Of logs that are shorter than so many of the shortest: a ball falls for three seconds only."""
_GLITCH = 8.0
"""Median deviations from the neighbouring rows beyond which a row is a glitch."""
_FARTHEST = 1e3
"""What a residual counts at most, in its unit: predictions may grow without bound."""
_STEEPEST = 100.0
"""Slope of a prediction beyond which residuals are differenced instead, with angles by the short way round and no
entry above _FARTHEST: predictions that part ways say nothing by how far."""
_ALIKE = 0.9
"""Share of the longest window's rows that windows have, from which recordings count as of one rate."""
_PUSH = 5.0
"""Times the median size of a window's residual beyond which it counts less."""


@dataclass(frozen=True)
class Shooting:
    """Windows that do not overlap, their starts, and what each compared row counts.

    ``rows`` (compared,): steps after the start at which states are compared, the start itself first.
    ``measured`` (windows, compared, states); ``counts`` the same shape, 0 to 1; ``starts`` (windows, states);
    ``tangent`` (windows, compared, states, states): derivative of the prediction with respect to the start;
    ``block`` (windows,): independent stretches of time; ``fold`` (windows,): what is held out together.
    """

    windows: Windows
    rows: IndexArray
    measured: FloatArray
    counts: FloatArray
    starts: FloatArray
    tangent: FloatArray
    block: IndexArray
    fold: IndexArray

    def residual(self, predicted: FloatArray) -> FloatArray:
        """predicted - measured (..., windows, compared, states), angles by the short way round."""
        with np.errstate(all="ignore"):
            found = self.windows.system.difference(predicted, np.broadcast_to(self.measured, predicted.shape))
        if found.size and found.min() >= -_FARTHEST and found.max() <= _FARTHEST:  # neither for NaN
            return found
        bounded = np.nan_to_num(found, nan=_FARTHEST, posinf=_FARTHEST, neginf=-_FARTHEST)
        return np.asarray(np.clip(bounded, -_FARTHEST, _FARTHEST))

    def residuals(self, models: Sequence[PhysicsModel]) -> FloatArray:
        """(models, windows, compared, states)"""
        return self.residual(np.moveaxis(simulate(models, self.windows, self.rows, self.starts), -1, 0))

    def linearised(self, models: Sequence[PhysicsModel], steps: Sequence[float], slopes: FloatArray) -> FloatArray:
        """The first model's residual (windows, compared, states).

        By how much each other one's is larger, over its step, is written into ``slopes`` (..., models - 1).
        """
        predicted = simulate(models, self.windows, self.rows, self.starts)
        with np.errstate(all="ignore"):
            np.subtract(predicted[..., 1:], predicted[..., :1], out=slopes)
            slopes /= np.asarray(steps)
        if slopes.size and not (slopes.min() >= -_STEEPEST and slopes.max() <= _STEEPEST):  # neither for NaN
            residuals = self.residual(np.moveaxis(predicted, -1, 0))
            slopes[...] = np.moveaxis((residuals[1:] - residuals[0]) / np.reshape(steps, (-1, 1, 1, 1)), 0, -1)
        return self.residual(predicted[..., 0])

    @cached_property
    def elimination(self) -> VariableProjection:
        """What takes a start's part out of residuals and slopes."""
        return VariableProjection(self.counts, self.tangent)

    def eliminated(self, columns: FloatArray, scale: FloatArray) -> FloatArray:
        """Columns (windows, compared, states, columns) over ``scale``, without what a start explains.

        c - A (A'A)^-1 A'c with A = sqrt(counts) tangent / scale; shape (windows, compared * states, columns).
        """
        return self.elimination.reduced(columns, scale)

    def squares(self, reduced: FloatArray) -> FloatArray:
        """Sum of the squares of a reduced residual (windows, compared * states), by window and state."""
        shaped = reduced.reshape(len(self.windows), len(self.rows), -1)
        return np.asarray((shaped**2).sum(axis=1))

    @cached_property
    def size(self) -> FloatArray:
        """How many independent numbers each state has: rows that count, less one start a window, shape (states,)."""
        return np.asarray(np.maximum(self.counts.sum(axis=(0, 1)) - len(self.windows), 1.0))

    @cached_property
    def by_block(self) -> IndexArray:
        """Windows in the order of their blocks, (windows,)."""
        return np.argsort(self.block, kind="stable")

    @cached_property
    def first_of_block(self) -> IndexArray:
        """Where each block begins in that order, (blocks,)."""
        return np.asarray(np.unique(self.block[self.by_block], return_index=True)[1], dtype=np.int64)

    def counted_by_rate(self, model: PhysicsModel) -> Shooting | None:
        """The same with glitches told by what is usual among the rows of each rate; None where windows have as many
        rows: there it is what counts already."""
        if (self.windows.steps[:, None] >= self.rows).mean() > _ALIKE:
            return None
        return replace(self, counts=_counts(self, self.residuals([model])[0], by_rate=True))

    def around(self, model: PhysicsModel, scale: FloatArray | None = None) -> Shooting:
        """The same with starts, derivatives and weights as they are best for one model."""
        found = replace(self, tangent=_tangent(self, model))
        residual = found.residuals([model])[0]
        found = replace(found, counts=_counts(found, residual))
        for _ in range(2):
            found, residual = _better_starts(found, model, residual, scale)
            found = replace(found, counts=_counts(found, residual), tangent=_tangent(found, model))
        return found


def _better_starts(
    shooting: Shooting, model: PhysicsModel, residual: FloatArray, scale: FloatArray | None
) -> tuple[Shooting, FloatArray]:
    """A Gauss-Newton step of every window's start, a quarter of it or none where the whole one does not help."""
    counts, tangent = shooting.counts, shooting.tangent
    weight = counts / (_robust(residual, counts) if scale is None else scale) ** 2
    normal = np.einsum("wnsi,wns,wnsj->wij", tangent, weight, tangent)
    normal += (1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(normal.shape[1])
    slope = np.einsum("wnsi,wns,wns->wi", tangent, weight, residual)
    shift = np.linalg.solve(normal, slope[..., None])[..., 0]
    best, now, rest = (residual**2 * weight).sum(axis=(1, 2)), residual.copy(), np.zeros(len(shift))
    for part in (1.0, 0.25):
        left = rest == 0.0
        if not left.any():
            break
        predicted = simulate([model], shooting.windows, shooting.rows, shooting.starts - part * shift)
        own = shooting.residual(predicted[..., 0])
        cost = (own**2 * weight).sum(axis=(1, 2))
        helps = left & (cost <= best)
        now[helps], best[helps], rest[helps] = own[helps], cost[helps], part
    return replace(shooting, starts=shooting.starts - rest[:, None] * shift), now


def shooting_of(runs: Sequence[Run], seconds: float, folds: int = 6) -> Shooting:
    """Windows of ``seconds`` one after the other; folds are runs, or stretches of time where there are few runs."""
    every = windows_of(runs, seconds, stride=1)
    windows = every.select(_one_after_the_other(every))
    longest = int(windows.steps.max())
    spacing = max(1, -(-longest // _ROWS))
    rows = np.unique(np.append(np.arange(0, longest, spacing), longest))
    at = windows.start[:, None] + rows
    inside = at <= windows.end[:, None]
    states = windows.states[np.minimum(at, windows.end[:, None])]
    size = states.shape[-1]
    identity = np.broadcast_to(np.eye(size), (*states.shape, size)).copy()
    clock = windows.clock[windows.start]
    block = block_seconds(runs)
    return Shooting(
        windows=windows,
        rows=rows,
        measured=states,
        counts=np.repeat(inside[..., None], size, axis=-1).astype(np.float64),
        starts=windows.states[windows.start].copy(),
        tangent=identity,
        block=np.unique(np.stack([windows.run, (clock / block).astype(np.int64)]), axis=1, return_inverse=True)[1],
        fold=folds_of(windows, folds),
    )


def block_seconds(runs: Sequence[Run]) -> float:
    """s of driving that count as independent of the next."""
    whole = sum(run.duration for run in runs)
    return float(np.clip(whole / _BLOCKS, min(_BLOCK[0], whole / _FEWEST_BLOCKS), _BLOCK[1]))


def folds_of(windows: Windows, folds: int) -> IndexArray:
    """What is held out together, (windows,): runs where there are three or more, else stretches of time."""
    runs = len(windows.names)
    if runs >= 3:
        return np.asarray(windows.run % folds, dtype=np.int64)
    found = np.zeros(len(windows), dtype=np.int64)
    for run in range(runs):
        own = np.flatnonzero(windows.run == run)
        if len(own):
            first, last = windows.clock[windows.start[own[0]]], windows.clock[windows.end[own]].max()
            share = (windows.clock[windows.start[own]] - first) / max(last - first, 1e-9)
            found[own] = np.minimum((share * folds).astype(np.int64), folds - 1)
    return found


def _tangent(shooting: Shooting, model: PhysicsModel) -> FloatArray:
    size = shooting.starts.shape[1]
    shifted = np.stack([shooting.starts, *(shooting.starts + _STEP * np.eye(size)[i] for i in range(size))])
    predicted = simulate([model] * (size + 1), shooting.windows, shooting.rows, shifted)
    with np.errstate(all="ignore"):
        return np.asarray(np.clip(np.nan_to_num((predicted[..., 1:] - predicted[..., :1]) / _STEP), -1e3, 1e3))


def _robust(residual: FloatArray, counts: FloatArray) -> FloatArray:
    """Root of the mean square of each state's residual without its largest 5 %, (states,); never 0."""
    found = np.empty(residual.shape[-1])
    for state in range(len(found)):
        squares = residual[..., state][counts[..., state] > 0] ** 2
        retained = max(1, int(0.95 * len(squares)))
        found[state] = np.sqrt(np.partition(squares, retained - 1)[:retained].mean())
    return np.maximum(found, 1e-7)


def _counts(shooting: Shooting, residual: FloatArray, *, by_rate: bool = False) -> FloatArray:
    """1 where a row is like its neighbours, 0 where it is a glitch; less in windows with a far larger residual.

    What is usual is told by all windows as if they were as long as the longest, which is strict about recordings of
    fewer rows a second; ``by_rate``: by the rows that those of each rate have.
    """
    inside = (shooting.windows.steps[:, None] >= shooting.rows)[..., None]
    from numpy.lib.stride_tricks import sliding_window_view

    padded = np.pad(residual, ((0, 0), (2, 2), (0, 0)), mode="reflect") if residual.shape[1] > 2 else residual
    if residual.shape[1] > 2:
        smooth = np.median(sliding_window_view(padded, 5, axis=1), axis=-1)
        rough = np.abs(residual - smooth)
        if by_rate:
            usual = _usual(rough, inside[..., 0], shooting.windows)
        else:
            usual = np.median(rough.reshape(-1, rough.shape[-1]), axis=0)
        typical = 1.4826 * usual + 1e-6
        retained = inside & (rough <= _GLITCH * typical).all(axis=-1, keepdims=True)
    else:
        retained = np.broadcast_to(inside, residual.shape)
    scale = _robust(residual, retained * np.ones_like(residual))
    size = np.sqrt((((residual / scale) ** 2) * retained).sum(axis=(1, 2)) / np.maximum(retained.sum(axis=(1, 2)), 1))
    light = np.minimum(1.0, (_PUSH * np.median(size) + 1e-12) / (size + 1e-12)) ** 2
    return np.asarray(retained * light[:, None, None] * np.ones_like(residual))


def _usual(rough: FloatArray, inside: NDArray[np.bool_], windows: Windows) -> FloatArray:
    """Median over the rows inside windows (windows, compared), of recordings with as many rows a second, (windows, 1,
    states): how rough a motion looks depends on how far apart its rows are."""
    found = np.empty((len(rough), 1, rough.shape[-1]))
    rates = np.round(np.log2(windows.period[windows.start]), 1)
    for rate in np.unique(rates):
        own = rates == rate
        found[own] = np.median(rough[own][inside[own]], axis=0)
    return found


def _one_after_the_other(windows: Windows) -> NDArray[np.int64]:
    retained, free = [], -1
    for index, (start, end) in enumerate(zip(windows.start.tolist(), windows.end.tolist(), strict=True)):
        if start >= free:
            retained.append(index)
            free = end
    return np.array(retained, dtype=np.int64)
