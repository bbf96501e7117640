"""Prediction-error method: the parameters that minimise the innovations of a Kalman filter along whole recordings.

minimise sum over the rows of e' S^-1 e + log det S,   e the innovations, S their covariance

The measurement noise and lasting disturbances of the rates are estimated with the parameters. The search works on
windows that restart instead, which attribute part of a lasting disturbance to a parameter. So these values are
reported.

Source: Ljung, System Identification, 2nd ed., 1999, sections 7.4 and 9.4 (covariance of prediction-error estimates);
Liang and Zeger, Biometrika 73, 1986 (sandwiches over groups).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.rollout import effective_actions_by_name
from safedpa.comparison.side_by_side import StackedMechanics
from safedpa.comparison.where import POSITION
from safedpa.comparison.windows import Windows
from safedpa.diagnosis.fit.kalman import Innovations, LinearizedTrajectory, Noise, kalman_innovations
from safedpa.diagnosis.fit.least_squares import (
    difference_step,
    prior_curvature,
    regularized_inverse,
    shifted,
    with_values,
)
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.base import AbstractBase
from safedpa.effects import CommandEffect, Conditioned, Where

# Length of a piece [s], and the time before it in which the filter settles. Pieces are filtered in parallel; several
# correlation times of a disturbance fit into one.
_PIECE, _SETTLING = 8.0, 1.0
# The sandwich over pieces needs at least two.
_MIN_PIECES = 2
# The noise has few parameters: 16 pieces determine it well enough.
_NOISE_PIECES = 16
# Newton steps for the noise in each round: more in the first, which starts from a rough guess.
_NEWTON = (3, 1, 1, 1, 1, 1)
# Standard deviations beyond which an innovation is an outlier; its noise is raised until it counts as this many.
_OUTLIER = 4.0
# Integration steps per row in each round. Dry friction is smoothed over a width that shrinks with the step, so the
# last rounds need fine ones.
_SUBSTEPS = (4, 4, 16)
# Callers that ask for at most so many rounds accept an error of 10 %: the finest steps are left out for them.
_ROUGH = 3
# Longer recordings are thinned to evenly spread pieces, which bounds the run time.
_MAX_ROWS = 16_000
# Difference of a state for the transition matrix, in its unit: far above rounding, small enough to stay linear.
_DIFFERENCE = 1e-4
# With fewer runs the spread between them is itself too uncertain.
_MIN_RUNS = 4
# Relative numerical error from integration. On long quiet recordings, dead zones, forces and frictions are stated to
# 5e-5 of themselves, while they are off by 1.3e-4 to 2.3e-4.
_NUMERICAL = 2e-4
# Numerical error of a border, relative to the width of its smooth edge: sharp edges came out 2 to 4 mm off for 50 mm.
_BORDER = 0.1


@dataclass(frozen=True)
class PredictionErrorFit:
    """A model with its final parameter values and their standard deviations (paths,), NaN for fixed parameters."""

    model: PhysicsModel
    paths: tuple[str, ...]
    deviations: FloatArray
    noise: Noise


def prediction_error_fit(
    model: PhysicsModel, paths: Sequence[str], free: NDArray[np.bool_], windows: Windows, rounds: int = len(_NEWTON)
) -> PredictionErrorFit | None:
    """Fits those of the parameters ``paths`` that are ``free`` (paths,), starting from their present values.

    Three ``rounds`` suffice where an error of 10 % does not matter. Returns None if the recordings are in pieces too
    short for a filter, or if a covariance is not positive definite.
    """
    try:
        return _fit_rounds(model, paths, free, windows, rounds)
    except np.linalg.LinAlgError:
        return None


def _fit_rounds(
    model: PhysicsModel, paths: Sequence[str], free: NDArray[np.bool_], windows: Windows, rounds: int
) -> PredictionErrorFit | None:
    chosen = [path for path, is_free in zip(paths, free.tolist(), strict=True) if is_free]
    pieces = _pieces(windows)
    if len(pieces.rows) < _MIN_PIECES:
        return None
    reference = windows.states[pieces.rows].copy()
    noise, noise_factor = _initial_noise(windows), np.ones(reference.shape)
    # Each round linearises about the smoothed reference, re-estimates the noise and takes one Gauss-Newton step.
    for round_index in range(rounds):
        finest = len(_SUBSTEPS) - (1 if rounds > _ROUGH else 2)
        substeps = _SUBSTEPS[min(round_index, finest)] if _integrated(model) else 1
        track = _linearize(model, chosen, _Steps(windows, pieces, substeps), reference, noise_factor, noise.measured[0])
        noise = _update_noise(track, noise, _NEWTON[round_index])
        found = kalman_innovations(track, noise)
        shift = _shift(model, chosen, found)
        reference = reference + found.states
        noise_factor = np.maximum(1.0, np.abs(found.ratio) * noise_factor / _OUTLIER)
        model, before = shifted(model, chosen, shift), model
        # Not before the third round: the substeps change until then.
        if round_index > 1 and _has_converged(before, model, chosen, found):
            break
    deviations = np.full(len(paths), np.nan)
    deviations[np.asarray(free, dtype=bool)] = np.hypot(
        _deviations(model, chosen, found, _runs_of(pieces, windows)), _numerical_error(model, chosen)
    )
    return PredictionErrorFit(model, tuple(paths), deviations, noise)


@dataclass(frozen=True)
class _Pieces:
    """Row indices of the table (pieces, rows); the last one is repeated where a piece is shorter."""

    rows: IndexArray
    inside: NDArray[np.bool_]
    counted: NDArray[np.bool_]


def _pieces(windows: Windows) -> _Pieces:
    """Cuts the recordings into pieces of 8 s, each with a settling time before it."""
    period = float(np.median(windows.period))
    length, before = max(4, round(_PIECE / period)), max(1, round(_SETTLING / period))
    spans = []
    for begin, stop in windows.bounds.tolist():
        for core in range(begin + before, stop - 2, length):
            spans.append((core - before, core, min(core + length, stop)))
    most = max(4, _MAX_ROWS // (length + before))
    spans = [spans[i] for i in np.unique(np.linspace(0, len(spans) - 1, min(most, len(spans))).astype(int))]
    starts, cores, stops = np.array(spans, dtype=np.int64).reshape(-1, 3).T
    rows = starts[:, None] + np.arange(length + before)
    inside = rows < stops[:, None]
    return _Pieces(np.minimum(rows, stops[:, None] - 1), inside, inside & (rows >= cores[:, None]))


@dataclass(frozen=True)
class _Steps:
    """One step of a model from every row of the pieces."""

    windows: Windows
    pieces: _Pieces
    substeps: int

    def ahead(self, model: PhysicsModel, states: FloatArray) -> FloatArray:
        """Returns the states one row later, (pieces, rows, states)."""
        flat = self.pieces.rows.reshape(-1)
        finer = self.substeps if _has_memory(model) else 1
        effective = effective_actions_by_name(model, self.finer if finer > 1 else self.windows)
        mechanics, now = StackedMechanics([model]), list(states.reshape(len(flat), -1).T)
        seconds = self.windows.period[flat] / self.substeps
        action = [column[finer * flat] for column in effective]
        with np.errstate(all="ignore"):
            for part in range(self.substeps):
                if part and finer > 1:
                    action = [column[finer * flat + part] for column in effective]
                now = mechanics.ahead(now, action, seconds, self.windows.time[flat] + part * seconds)
        return np.clip(np.nan_to_num(np.stack(now, axis=-1)), -1e6, 1e6).reshape(states.shape)

    @cached_property
    def finer(self) -> Windows:
        """The table with every row divided into substeps: the output of a lag or delay changes within a row."""
        windows, parts = self.windows, self.substeps
        period, actions = np.repeat(windows.period / parts, parts), np.repeat(windows.actions, parts, axis=0)
        return replace(windows, period=period, actions=actions, bounds=windows.bounds * parts, memo={})


def _has_memory(model: PhysicsModel) -> bool:
    """Returns whether the actuators have memory, so that earlier commands matter."""
    names = dict.fromkeys(model.system.action_names, 0.0)
    commands = [item for item in model.effects if isinstance(item, CommandEffect)]
    return any(item.initial_memory(names) is not None for item in commands)


def _integrated(model: PhysicsModel) -> bool:
    """Returns whether the model integrates rates; a learned change over a period cannot be divided into substeps."""
    return type(model.base).integrate is AbstractBase.integrate


def _linearize(
    model: PhysicsModel,
    paths: Sequence[str],
    step: _Steps,
    reference: FloatArray,
    noise_factor: FloatArray,
    noise: FloatArray,
) -> LinearizedTrajectory:
    """Linearises the model about the reference: one step from every row, with derivatives by differences."""
    size = reference.shape[-1]
    steps = [difference_step(model.parameters[path], model.settings[path].value) for path in paths]
    nearby = [with_values(model, {p: model.settings[p].value + s}) for p, s in zip(paths, steps, strict=True)]
    ahead = step.ahead(model, reference)
    shifted = [step.ahead(model, reference + _DIFFERENCE * np.eye(size)[i]) for i in range(size)]
    varied = [(step.ahead(variant, reference) - ahead) / s for variant, s in zip(nearby, steps, strict=True)]
    transition = np.stack([(one - ahead) / _DIFFERENCE for one in shifted], axis=-1)
    following = np.concatenate([reference[:, 1:], reference[:, -1:]], axis=1)
    system = step.windows.system
    difference = system.difference
    return LinearizedTrajectory(
        transition=transition,
        nonlinearity=_linearization_error(model, step, reference, ahead, transition, noise),
        drift=difference(ahead, following),
        columns=np.stack(varied, axis=-1) if varied else np.zeros((*reference.shape, 0)),
        measured=difference(step.windows.states[step.pieces.rows], reference),
        period=step.windows.period[step.pieces.rows],
        inside=step.pieces.inside,
        counted=step.pieces.counted,
        noise_factor=noise_factor,
        disturbed=np.array([i for i, v in enumerate(system.state) if v.name not in POSITION], dtype=np.int64),
    )


def _linearization_error(
    model: PhysicsModel,
    step: _Steps,
    reference: FloatArray,
    ahead: FloatArray,
    transition: FloatArray,
    noise: FloatArray,
) -> FloatArray:
    """Returns max |model(x + e) - model(x) - T e| over steps e of plus and minus one deviation of the measurement."""
    largest = np.zeros(reference.shape)
    for index, size in enumerate(noise.tolist()):
        # The dynamics do not depend on the position, so it adds no linearisation error.
        if step.windows.system.state_names[index] in POSITION:
            continue
        for part in (-size, size):
            shift = part * np.eye(len(noise))[index]
            change = step.ahead(model, reference + shift) - ahead
            largest = np.maximum(largest, np.abs(change - part * transition[..., index]))
    return largest


def _initial_noise(windows: Windows) -> Noise:
    """Guesses the measurement noise from third differences of the rows, and disturbances of three times that size."""
    states = windows.states
    difference = windows.system.difference
    jumps = difference(states[1:], states[:-1])
    third = np.diff(jumps, n=2, axis=0)
    # The third difference of white noise has variance 1 + 9 + 9 + 1 = 20; smooth motion hardly contributes to it.
    measured = np.maximum(np.median(np.abs(third), axis=0) * 1.4826 / np.sqrt(20.0), 1e-6)
    disturbed = [i for i, v in enumerate(windows.system.state) if v.name not in POSITION]
    return Noise(measured[None], 3.0 * measured[disturbed][None], np.ones(1))


def _update_noise(track: LinearizedTrajectory, noise: Noise, rounds: int) -> Noise:
    """Takes Newton steps for the logarithms of the noise parameters, each one separately, on some of the pieces."""
    pick = np.unique(np.linspace(0, len(track.measured) - 1, _NOISE_PIECES).astype(int))
    part = replace(track, **{name: value[pick] for name, value in vars(track).items() if name != "disturbed"})
    now = np.log(np.concatenate([noise.measured[0], noise.disturbances[0], noise.seconds]))
    states, width = noise.measured.shape[-1], 0.2
    for _ in range(rounds):
        eye = width * np.eye(len(now))
        cost = kalman_innovations(
            part, _noise_of(np.concatenate([now[None], now + eye, now - eye]), states), slopes=False
        ).cost
        up, down = cost[1 : 1 + len(now)], cost[1 + len(now) :]
        # All difference quotients come from one batched pass of the filter.
        slope, curvature = (up - down) / (2 * width), (up + down - 2 * cost[0]) / width**2
        # The floor on the curvature bounds a step where the likelihood is flat or concave.
        step = -slope / np.maximum(curvature, 0.5 * np.abs(slope) + 1.0)
        # A line search over fixed fractions; fraction 0 makes sure that the cost never rises.
        steps = np.clip(step, -2.0, 2.0) * np.array([[1.0], [0.5], [0.2], [0.0]])
        tried = now + steps
        # Correlation times below 0.1 s look like measurement noise, and above 10 s like a constant.
        tried[:, -1] = np.clip(tried[:, -1], np.log(0.1), np.log(10.0))
        cost = kalman_innovations(part, _noise_of(tried, states), slopes=False).cost
        now = tried[int(np.argmin(cost))]
    return _noise_of(now[None], states)


def _noise_of(logs: FloatArray, states: int) -> Noise:
    # e^-16 to e^8 covers every unit in use and keeps exp() from overflowing.
    values = np.exp(np.clip(logs, -16.0, 8.0))
    return Noise(values[:, :states], values[:, states:-1], values[:, -1])


def _shift(model: PhysicsModel, paths: Sequence[str], found: Innovations) -> FloatArray:
    """Returns the Gauss-Newton step -(J'J + prior)^-1 J' e, (paths,)."""
    slope = np.einsum("wip,wi->p", found.columns, found.white)
    curvature = np.einsum("wip,wiq->pq", found.columns, found.columns)
    return -np.asarray(regularized_inverse(curvature + np.diag(prior_curvature(model, paths))) @ slope)


def _has_converged(before: PhysicsModel, after: PhysicsModel, paths: Sequence[str], found: Innovations) -> bool:
    """Returns whether every parameter moved by less than a tenth of its deviation."""
    change = np.array([after.settings[path].value - before.settings[path].value for path in paths])
    return bool((np.abs(change) < 0.1 * _deviations(after, paths, found)).all())


def _numerical_error(model: PhysicsModel, paths: Sequence[str]) -> FloatArray:
    """Returns the numerical error of each parameter from integration and smoothed corners, (paths,)."""
    neutral = [model.parameters[path].neutral for path in paths]
    values = [model.settings[path].value for path in paths]
    found = _NUMERICAL * np.abs([value - (at or 0.0) for value, at in zip(values, neutral, strict=True)])
    return np.asarray(np.hypot(found, [_border_error(model, path) for path in paths]))


def _border_error(model: PhysicsModel, path: str) -> float:
    """Returns the numerical error of a border from the shape of its smoothed edge; 0 for other parameters."""
    owner, name = path.split(".")
    item = next((effect for effect in model.effects if effect.name == owner), None)
    if not isinstance(item, Conditioned) or not isinstance(item.law, Where):
        return 0.0
    names = {parameter.name for parameter in item.inner.parameters}
    return 0.0 if name in names else _BORDER * item.law.edge


def _runs_of(pieces: _Pieces, windows: Windows) -> IndexArray:
    """Returns the run of each piece (pieces,); a stretch without a window counts as a separate run."""
    known = dict(zip(windows.begin.tolist(), windows.run.tolist(), strict=True))
    stretch = np.searchsorted(windows.bounds[:, 1], pieces.rows[:, 0], side="right")
    begins = windows.bounds[stretch, 0].tolist()
    return np.array([known.get(begin, len(windows.names) + begin) for begin in begins], dtype=np.int64)


def _deviations(
    model: PhysicsModel, paths: Sequence[str], found: Innovations, runs: IndexArray | None = None
) -> FloatArray:
    """Returns one standard deviation (paths,): the largest of the filter's and of sandwich estimates.

    The sandwich over groups is C (sum over the groups of s s') C with the filter's covariance C and the score s
    (paths,) of a group. Groups are pieces, and runs (times R / (R - 1) for R runs) if there are four or more. Pieces of
    one run can all be biased to the same side, which only the sandwich over runs shows.
    """
    curvature = np.einsum("wip,wiq->pq", found.columns, found.columns)
    information = regularized_inverse(curvature + np.diag(prior_curvature(model, paths)), 1e-12)
    scores = np.einsum("wip,wi->wp", found.columns, found.white)
    squares = [np.diag(information), np.diag(information @ (scores.T @ scores) @ information)]
    groups = np.unique(runs) if runs is not None else np.zeros(0)
    if len(groups) >= _MIN_RUNS:
        sums = np.stack([scores[runs == group].sum(axis=0) for group in groups])
        share = len(groups) / (len(groups) - 1.0)
        squares.append(share * np.diag(information @ (sums.T @ sums) @ information))
    return np.asarray(np.sqrt(np.maximum(np.max(squares, axis=0), 0.0)))
