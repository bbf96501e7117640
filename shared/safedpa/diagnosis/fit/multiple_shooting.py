"""Multiple shooting: short rollouts of a model, each from its own estimated start.

The measured start of a window is noisy, so its entries are unknowns too. They are eliminated from the residuals to
first order, window by window (variable projection). The reduced residuals depend on the model alone. All windows of all
runs, and all variants of a model, are simulated together.

Source: Bock and Plitt, A multiple shooting algorithm, IFAC 1984; Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.rollout import effective_actions_by_name
from safedpa.comparison.side_by_side import StackedMechanics
from safedpa.comparison.windows import Windows, windows_of
from safedpa.dynamics import PhysicsModel
from safedpa.effects import CommandEffect
from safedpa.records.run import Run

# Compared rows of a window at most: more rows of a smooth residual add cost, but hardly any information.
_MAX_ROWS = 24
# Below three rows the first part of a window contains no rate.
_MIN_FIRST_ROWS = 3
# Difference of a start's entry, in its unit: large enough for double precision, small enough to stay linear.
_DIFFERENCE = 1e-4
# Weights of a third difference.
_DIFFERENCE_WEIGHTS = np.array([1.0, -3.0, 3.0, -1.0])
# Number of blocks wanted. The spread of 40 block sums is known well enough for a test of 3 standard errors.
_BLOCKS = 40
# Bounds on the length of a block [s]. Shorter blocks are not independent of their neighbours; longer ones are too few.
_BLOCK_SECONDS = (3.0, 10.0)
# Recordings too short for ten blocks of 3 s get shorter blocks: a ball falls for three seconds only.
_MIN_BLOCKS = 10
# Robust deviations from the median of the neighbouring rows beyond which a row is a glitch: far outside Gaussian noise.
_GLITCH = 8.0
# Share of the rows that may be glitches: what is rough more often is the motion, as where dry friction reverses.
_MOST_GLITCHES = 0.1
# Bound on a residual, in its unit: predictions of an unstable model may grow without bound.
_MAX_RESIDUAL = 1e3
# Slope of a prediction beyond which residuals are differenced instead, with angles wrapped and entries bounded by
# _MAX_RESIDUAL: trajectories that have diverged carry no information in how far they are apart.
_MAX_SLOPE = 100.0
# Share of windows as long as the longest from which all recordings count as of one sampling rate: jitter makes some
# windows a row shorter.
_ONE_RATE = 0.9
# Windows with a residual above this multiple of the median are down-weighted: a person pushed the robot there.
_DISTURBED = 5.0


@dataclass(frozen=True)
class Shooting:
    """Windows that do not overlap, their starts, and the weight of each compared row.

    ``rows`` (compared,): steps after the start at which states are compared, the start itself first.
    ``measured`` (windows, compared, states); ``counts`` the same shape, 0 to 1; ``starts`` (windows, states);
    ``tangent`` (windows, compared, states, states): derivative of the prediction with respect to the start. ``block``
    (windows,): index of the independent stretch of time; ``fold`` (windows,): index of the cross-validation fold.
    """

    windows: Windows
    rows: IndexArray
    measured: FloatArray
    counts: FloatArray
    starts: FloatArray
    tangent: FloatArray
    block: IndexArray
    fold: IndexArray
    recorded: Windows | None = None
    """The windows as recorded, where ``windows`` has commands that change between rows."""

    def residual(self, predicted: FloatArray) -> FloatArray:
        """Returns predicted - measured (..., windows, compared, states), with angle differences wrapped."""
        with np.errstate(all="ignore"):
            found = self.windows.system.difference(predicted, np.broadcast_to(self.measured, predicted.shape))
        # Both comparisons are false for NaN, so one pass checks for NaN as well; the usual case returns without a copy.
        if found.size and found.min() >= -_MAX_RESIDUAL and found.max() <= _MAX_RESIDUAL:
            return found
        bounded = np.nan_to_num(found, nan=_MAX_RESIDUAL, posinf=_MAX_RESIDUAL, neginf=-_MAX_RESIDUAL)
        return np.asarray(np.clip(bounded, -_MAX_RESIDUAL, _MAX_RESIDUAL))

    def residuals(self, models: Sequence[PhysicsModel]) -> FloatArray:
        """Returns the residuals of several models, (models, windows, compared, states)."""
        return self.residual(np.moveaxis(simulate(models, self.windows, self.rows, self.starts), -1, 0))

    def linearised(self, models: Sequence[PhysicsModel], steps: Sequence[float], slopes: FloatArray) -> FloatArray:
        """Returns the residual of the first model (windows, compared, states).

        Writes the difference quotients of the other models, over their ``steps``, into ``slopes`` (..., models - 1).
        """
        predicted = simulate(models, self.windows, self.rows, self.starts)
        with np.errstate(all="ignore"):
            np.subtract(predicted[..., 1:], predicted[..., :1], out=slopes)
            slopes /= np.asarray(steps)
        if slopes.size and not (slopes.min() >= -_MAX_SLOPE and slopes.max() <= _MAX_SLOPE):  # true for NaN as well
            residuals = self.residual(np.moveaxis(predicted, -1, 0))
            slopes[...] = np.moveaxis((residuals[1:] - residuals[0]) / np.reshape(steps, (-1, 1, 1, 1)), 0, -1)
        return self.residual(predicted[..., 0])

    @cached_property
    def elimination(self) -> VariableProjection:
        """The projection that removes from residuals and slopes what a change of the start explains."""
        return VariableProjection(self.counts, self.tangent)

    def eliminated(self, columns: FloatArray, scale: FloatArray) -> FloatArray:
        """Returns columns (windows, compared, states, columns) over ``scale``, without what a start explains.

        c - A (A'A)^-1 A'c with A = sqrt(counts) tangent / scale; shape (windows, compared * states, columns).
        """
        return self.elimination.reduced(columns, scale)

    def squares(self, reduced: FloatArray) -> FloatArray:
        """Returns the sums of squares of a reduced residual (windows, compared * states), by window and state."""
        shaped = reduced.reshape(len(self.windows), len(self.rows), -1)
        return np.asarray((shaped**2).sum(axis=1))

    @cached_property
    def size(self) -> FloatArray:
        """Degrees of freedom of each state (states,): weighted rows minus one start per window."""
        return np.asarray(np.maximum(self.counts.sum(axis=(0, 1)) - len(self.windows), 1.0))

    @cached_property
    def by_block(self) -> IndexArray:
        """Windows in the order of their blocks, (windows,)."""
        return np.argsort(self.block, kind="stable")

    @cached_property
    def first_of_block(self) -> IndexArray:
        """Index of the first window of each block in that order, (blocks,)."""
        return np.asarray(np.unique(self.block[self.by_block], return_index=True)[1], dtype=np.int64)

    def with_commands(self, *, between_rows: bool) -> Shooting:
        """Returns the windows with commands that change at the rows that show them, or half a period before."""
        if between_rows == (self.recorded is not None):
            return self
        if self.recorded is not None:
            return replace(self, windows=self.recorded, recorded=None)
        return replace(self, windows=halfway_between_rows(self.windows), recorded=self.windows)

    def first_part(self) -> Shooting:
        """Returns the first fifth of each window, at least three compared rows."""
        count = max(_MIN_FIRST_ROWS, len(self.rows) // 5)
        return replace(
            self,
            rows=self.rows[:count],
            measured=self.measured[:, :count],
            counts=self.counts[:, :count],
            tangent=self.tangent[:, :count],
        )

    def with_weights_by_rate(self, model: PhysicsModel) -> Shooting | None:
        """Returns the windows with glitches detected separately for each sampling rate.

        Returns None if all windows have the same number of rows: the weights would be those already in use.
        """
        if (self.windows.steps[:, None] >= self.rows).mean() > _ONE_RATE:
            return None
        return replace(self, counts=_row_weights(self, self.residuals([model])[0], by_rate=True))

    def around(self, model: PhysicsModel, scale: FloatArray | None = None) -> Shooting:
        """Returns the same windows with starts, derivatives and weights updated for one model."""
        found = replace(self, tangent=_tangent(self, model))
        residual = found.residuals([model])[0]
        found = replace(found, counts=_row_weights(found, residual))
        # Starts, weights and tangents depend on each other; the second round changes them little.
        for _ in range(2):
            found, residual = _better_starts(found, model, residual, scale)
            found = replace(found, counts=_row_weights(found, residual), tangent=_tangent(found, model))
        return found


def halfway_between_rows(windows: Windows) -> Windows:
    """Returns windows whose commands change halfway between rows: (u[k] + u[k + 1]) / 2 from row k on."""
    following = np.arange(len(windows.actions)) + 1
    # The last row of a stretch has no row after it whose command is known.
    following[windows.bounds[:, 1] - 1] = windows.bounds[:, 1] - 1
    return replace(windows, actions=0.5 * (windows.actions + windows.actions[following]), memo={})


def measurement_noise(windows: Windows) -> FloatArray:
    """Returns the standard deviation of each state's noise (states,), NaN without data.

    From third differences, which contain hardly any motion.
    """
    found = np.full(windows.states.shape[1], np.nan)
    for index in range(len(found)):
        parts = [windows.states[begin:stop, index] for begin, stop in windows.bounds.tolist() if stop - begin > 4]
        if parts:
            differences = np.concatenate([np.convolve(part, _DIFFERENCE_WEIGHTS, mode="valid") for part in parts])
            # The median ignores glitches and steps; 0.6745 relates it to the deviation of Gaussian noise.
            found[index] = np.median(np.abs(differences)) / 0.6745 / np.linalg.norm(_DIFFERENCE_WEIGHTS)
    return found


def _better_starts(
    shooting: Shooting, model: PhysicsModel, residual: FloatArray, scale: FloatArray | None
) -> tuple[Shooting, FloatArray]:
    """Takes a Gauss-Newton step of every window's start: the whole step, a quarter of it, or none if neither helps."""
    counts, tangent = shooting.counts, shooting.tangent
    weight = counts / (_trimmed_scale(residual, counts) if scale is None else scale) ** 2
    normal = np.einsum("wnsi,wns,wnsj->wij", tangent, weight, tangent)
    # A state that the window does not observe has no curvature; the ridge keeps the matrix invertible.
    normal += (1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(normal.shape[1])
    slope = np.einsum("wnsi,wns,wns->wi", tangent, weight, residual)
    shift = np.linalg.solve(normal, slope[..., None])[..., 0]
    best, now, taken = (residual**2 * weight).sum(axis=(1, 2)), residual.copy(), np.zeros(len(shift))
    for fraction in (1.0, 0.25):
        pending = taken == 0.0
        if not pending.any():
            break
        predicted = simulate([model], shooting.windows, shooting.rows, shooting.starts - fraction * shift)
        stepped = shooting.residual(predicted[..., 0])
        cost = (stepped**2 * weight).sum(axis=(1, 2))
        helps = pending & (cost <= best)
        now[helps], best[helps], taken[helps] = stepped[helps], cost[helps], fraction
    return replace(shooting, starts=shooting.starts - taken[:, None] * shift), now


def shooting_of(runs: Sequence[Run], seconds: float, folds: int = 6) -> Shooting:
    """Returns windows of ``seconds`` one after the other; folds are runs, or stretches of time for few runs."""
    every = windows_of(runs, seconds, stride=1)
    windows = every.select(_non_overlapping(every))
    longest = int(windows.steps.max())
    spacing = max(1, -(-longest // _MAX_ROWS))
    # The last row is always compared: the effect of a missing force is largest there.
    rows = np.unique(np.append(np.arange(0, longest, spacing), longest))
    at = windows.start[:, None] + rows
    inside = at <= windows.end[:, None]
    states = windows.states[np.minimum(at, windows.end[:, None])]
    size = states.shape[-1]
    # Without a model the tangent is the identity, as if states stayed constant; around() replaces it.
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
    """Returns the length [s] of a block: stretches of driving that count as independent of each other."""
    whole = sum(run.duration for run in runs)
    return float(np.clip(whole / _BLOCKS, min(_BLOCK_SECONDS[0], whole / _MIN_BLOCKS), _BLOCK_SECONDS[1]))


def folds_of(windows: Windows, folds: int) -> IndexArray:
    """Returns the fold of each window (windows,): whole runs if there are three or more, else stretches of time."""
    runs = len(windows.names)
    # Runs differ in load, floor and driver, so holding out whole runs is the stricter test. With fewer than three, the
    # fit without a run would see one kind of driving only.
    if runs >= 3:
        return np.asarray(windows.run % folds, dtype=np.int64)
    found = np.zeros(len(windows), dtype=np.int64)
    for run in range(runs):
        members = np.flatnonzero(windows.run == run)
        if len(members):
            first, last = windows.clock[windows.start[members[0]]], windows.clock[windows.end[members]].max()
            # Contiguous stretches of time, because neighbouring windows are correlated.
            share = (windows.clock[windows.start[members]] - first) / max(last - first, 1e-9)
            found[members] = np.minimum((share * folds).astype(np.int64), folds - 1)
    return found


def _tangent(shooting: Shooting, model: PhysicsModel) -> FloatArray:
    """Returns the derivative of the prediction with respect to the start, by forward differences."""
    size = shooting.starts.shape[1]
    shifted = np.stack([shooting.starts, *(shooting.starts + _DIFFERENCE * np.eye(size)[i] for i in range(size))])
    predicted = simulate([model] * (size + 1), shooting.windows, shooting.rows, shifted)
    with np.errstate(all="ignore"):
        return np.asarray(np.clip(np.nan_to_num((predicted[..., 1:] - predicted[..., :1]) / _DIFFERENCE), -1e3, 1e3))


def _trimmed_scale(residual: FloatArray, counts: FloatArray) -> FloatArray:
    """Returns each state's root mean square residual without its largest 5 %, (states,); at least 1e-7."""
    found = np.empty(residual.shape[-1])
    for state in range(len(found)):
        squares = residual[..., state][counts[..., state] > 0] ** 2
        retained = max(1, int(0.95 * len(squares)))
        found[state] = np.sqrt(np.partition(squares, retained - 1)[:retained].mean())
    return np.maximum(found, 1e-7)


def _row_weights(shooting: Shooting, residual: FloatArray, *, by_rate: bool = False) -> FloatArray:
    """Returns the weight of each row: 0 for a glitch, 1 otherwise, less in windows with a far larger residual.

    The usual roughness is the median over all windows, padded to the length of the longest one. That is strict about
    recordings with fewer rows per second; ``by_rate`` takes the median for each sampling rate instead.
    """
    inside = (shooting.windows.steps[:, None] >= shooting.rows)[..., None]
    from numpy.lib.stride_tricks import sliding_window_view

    padded = np.pad(residual, ((0, 0), (2, 2), (0, 0)), mode="reflect") if residual.shape[1] > 2 else residual
    if residual.shape[1] > 2:
        # The median of five rows ignores up to two glitches next to each other.
        smooth = np.median(sliding_window_view(padded, 5, axis=1), axis=-1)
        roughness = np.abs(residual - smooth)
        if by_rate:
            usual = _usual_roughness(roughness, inside[..., 0], shooting.windows)
        else:
            usual = np.median(roughness.reshape(-1, roughness.shape[-1]), axis=0)
        # 1.4826 times the median deviation estimates the standard deviation of Gaussian noise.
        typical = 1.4826 * usual + 1e-6
        worst = np.where(inside, (roughness / typical).max(axis=-1, keepdims=True), 0.0)
        often = float(np.quantile(worst[inside], 1.0 - _MOST_GLITCHES)) if inside.any() else 0.0
        retained = inside & (worst <= max(_GLITCH, often))
    else:
        retained = np.broadcast_to(inside, residual.shape)
    scale = _trimmed_scale(residual, retained * np.ones_like(residual))
    size = np.sqrt((((residual / scale) ** 2) * retained).sum(axis=(1, 2)) / np.maximum(retained.sum(axis=(1, 2)), 1))
    # Weight (k / size)^2 bounds the squares of a disturbed window at those of a window k times the median.
    light = np.minimum(1.0, (_DISTURBED * np.median(size) + 1e-12) / (size + 1e-12)) ** 2
    return np.asarray(retained * light[:, None, None] * np.ones_like(residual))


def _usual_roughness(rough: FloatArray, inside: NDArray[np.bool_], windows: Windows) -> FloatArray:
    """Returns the median roughness among recordings of the same sampling rate, (windows, 1, states).

    ``inside`` (windows, compared) marks existing rows. How rough a motion looks depends on the spacing of its rows.
    """
    found = np.empty((len(rough), 1, rough.shape[-1]))
    # Rates within 7 % of each other (a tenth of an octave) count as the same: recorders jitter.
    rates = np.round(np.log2(windows.period[windows.start]), 1)
    for rate in np.unique(rates):
        members = rates == rate
        found[members] = np.median(rough[members][inside[members]], axis=0)
    return found


def _non_overlapping(windows: Windows) -> NDArray[np.int64]:
    """Returns the windows chosen greedily so that each starts at or after the end of the one before."""
    retained, free = [], -1
    for index, (start, end) in enumerate(zip(windows.start.tolist(), windows.end.tolist(), strict=True)):
        if start >= free:
            retained.append(index)
            free = end
    return np.array(retained, dtype=np.int64)


def simulate(models: Sequence[PhysicsModel], windows: Windows, rows: IndexArray, starts: FloatArray) -> FloatArray:
    """Returns predicted states (windows, compared, states, models) of models that differ only in parameter values.

    ``starts`` is (windows, states) or (models, windows, states). Entries beyond the end of a window are meaningless.
    The models are the last axis because a fit works on one window's values of all models at a time.
    """
    count, size = len(windows), starts.shape[-1]
    # All models advance together: one vectorised step instead of one Python call per model.
    mechanics, effective = StackedMechanics(models), _effective_actions(models, windows)
    states = [np.ascontiguousarray(starts[..., index]) for index in range(size)]
    period = windows.common_period
    found = np.empty((count, len(rows), size, len(models)))
    column_of_row = {int(row): index for index, row in enumerate(rows)}
    last = int(rows[-1])
    with np.errstate(all="ignore"):
        for step in range(last + 1):
            if step in column_of_row:
                for index, column in enumerate(states):
                    found[:, column_of_row[step], index] = column.T if column.ndim == 2 else column[:, None]
            if step < last:
                # Shorter windows repeat their last step; callers ignore those rows.
                at = np.minimum(windows.start + step, windows.end - 1)
                seconds: Any = windows.period[at] if period is None else period
                states = mechanics.ahead(states, [column[..., at] for column in effective], seconds, windows.time[at])
    return found


def _effective_actions(models: Sequence[PhysicsModel], windows: Windows) -> list[FloatArray]:
    """Returns the actions after lags, delays and limits: (rows,) if all models agree, else (models, rows)."""
    # Difference quotients change one parameter at a time, so most variants share their commands: compute those once.
    if len({_command_parameters(model) for model in models}) == 1:
        return effective_actions_by_name(models[0], windows)
    columns = [effective_actions_by_name(model, windows) for model in models]
    found = []
    for variants in zip(*columns, strict=True):
        same = all(np.array_equal(variants[0], other) for other in variants[1:])
        found.append(variants[0] if same else np.stack(variants))
    return found


def _command_parameters(model: PhysicsModel) -> tuple[float, ...]:
    """Returns the parameter values of the effects that act on commands."""
    commands = [item for item in model.effects if isinstance(item, CommandEffect)]
    return tuple(model.settings[f"{item.name}.{p.name}"].value for item in commands for p in item.parameters)


# Ridge, relative to the curvature: a state of the start may not be observed by any row.
_RIDGE = 1e-9
# Windows that are reduced together: their arrays stay in the CPU cache, which took a quarter of the time.
_CHUNK = 64
# Scales whose inverses are cached: a fit uses the last two again.
_CACHED = 4


@final
@dataclass(frozen=True)
class ProjectedProducts:
    """Products of the residuals of some models, before division by a scale.

    ``squares`` (states, models); ``slopes`` (windows, states, starts, models) holds A_s'r_s.
    """

    squares: FloatArray
    slopes: FloatArray


@final
class VariableProjection:
    """Variable projection: removes from residuals and slopes what a change of each window's start explains.

    With ``counts`` (windows, compared, states), ``tangent`` (windows, compared, states, starts) and
    A_w = sqrt(counts) tangent / scale of window w, a column c (such as sqrt(counts) residual / scale) becomes

        c - A (A'A)^-1 A'c.

    The squares do not need the reduced column. For a residual r and the best shift x = (A'A)^-1 A'r of the start, the
    part of state s is r_s'r_s - 2 x'A_s'r_s + x'A_s'A_s x. The products A_s'A_s are computed once for all scales, and
    A_s'r_s once for each residual.
    """

    def __init__(self, counts: FloatArray, tangent: FloatArray) -> None:
        self._root = np.sqrt(counts)
        self._basis = tangent * self._root[..., None]
        self._inverses: dict[bytes, FloatArray] = {}

    @cached_property
    def _basis_transposed(self) -> FloatArray:
        """A_s' before division by a scale, (windows, states, starts, compared)."""
        return np.ascontiguousarray(self._basis.transpose(0, 2, 3, 1))

    @cached_property
    def _grams(self) -> FloatArray:
        """A_s'A_s before division by a scale, (windows, states, starts, starts)."""
        return np.asarray(self._basis_transposed @ self._basis_transposed.swapaxes(-1, -2))

    def reduced(self, columns: FloatArray, scale: FloatArray) -> FloatArray:
        """Reduces columns (windows, compared, states, columns) to (windows, compared * states, columns)."""
        inverse, found = self._inverse(scale), np.empty(columns.shape)
        for begin in range(0, len(columns), _CHUNK):
            chunk = slice(begin, begin + _CHUNK)
            np.multiply(columns[chunk], (self._root[chunk] / scale)[..., None], out=found[chunk])
            wide = found[chunk].reshape(len(found[chunk]), -1, columns.shape[-1])
            basis = (self._basis[chunk] / scale[:, None]).reshape(len(wide), -1, self._basis.shape[-1])
            wide -= basis @ (inverse[chunk] @ (basis.swapaxes(1, 2) @ wide))
        return found.reshape(len(columns), -1, columns.shape[-1])

    def products(self, residuals: FloatArray) -> ProjectedProducts:
        """Computes the products of residuals (models, windows, compared, states), which serve all scales."""
        weighted = np.ascontiguousarray((residuals * self._root).transpose(1, 3, 2, 0))
        return ProjectedProducts(np.einsum("wsnm,wsnm->sm", weighted, weighted), self._basis_transposed @ weighted)

    def squares(self, products: ProjectedProducts, scale: FloatArray) -> FloatArray:
        """Returns the sum over the windows of the reduced residuals' squares in the states' units, (states, models)."""
        right = np.einsum("wsjm,s->wjm", products.slopes, scale**-2.0)
        shift = self._inverse(scale) @ right
        correction = self._grams @ shift[:, None] - 2.0 * products.slopes
        # The difference of large products can round to slightly below zero.
        return np.asarray(np.maximum(products.squares + np.einsum("wsjm,wjm->sm", correction, shift), 0.0))

    def _inverse(self, scale: FloatArray) -> FloatArray:
        """Returns (A'A)^-1 of each window, (windows, starts, starts)."""
        key = scale.tobytes()
        if key not in self._inverses:
            while len(self._inverses) >= _CACHED:
                self._inverses.pop(next(iter(self._inverses)))
            gram = np.einsum("wsjk,s->wjk", self._grams, scale**-2.0)
            # Scaling the diagonal to 1 makes the ridge independent of the units of the states.
            size = np.sqrt(np.diagonal(gram, axis1=1, axis2=2)) + 1e-30
            outer = size[:, :, None] * size[:, None, :]
            self._inverses[key] = np.linalg.inv(gram / outer + _RIDGE * np.eye(gram.shape[1])) / outer
        return self._inverses[key]
